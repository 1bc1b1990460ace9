// Send a scan from an app on iOS: a resumable upload (tus 1.0.0), and a job of it. Foundation alone.
//
//     let job = try await Advtex(server: url, key: "adv_...").texture(scan: file, label: "kitchen")

import CryptoKit
import Foundation

struct Refused: Error, Decodable {
    let code: String
    let message: String
    let help: String  // a path on the server that explains the code
}

struct Job: Decodable {
    struct Progress: Decodable { let stage: String; let step: Int; let steps: Int }
    struct Failure: Decodable { let code: String; let message: String }
    let id: String
    let state: String  // checking, queued, running, preempted; ends as succeeded, failed, canceled or rejected
    let progress: Progress
    let error: Failure?
}

struct Advtex {
    let server: URL
    let key: String
    private let piece = 4 << 20  // bytes per request: after each, the server has them for good

    func texture(scan: URL, label: String) async throws -> Job {
        let body = try JSONSerialization.data(
            withJSONObject: ["upload_id": try await upload(scan), "options": ["preset": "auto"], "label": label],
            options: .sortedKeys)
        // The same key and body are the same job, however often this is sent.
        let once = SHA256.hash(data: body).map { String(format: "%02x", $0) }.joined()
        let headers = ["Content-Type": "application/json", "Idempotency-Key": once]
        return try JSONDecoder().decode(Job.self, from: try await call("POST", "/v1/jobs", headers, body).0)
    }

    func job(_ id: String) async throws -> Job {
        try JSONDecoder().decode(Job.self, from: try await call("GET", "/v1/jobs/\(id)").0)
    }

    /// `model.usdz` opens in AR Quick Look.
    func download(_ name: String, of job: Job, to file: URL) async throws {
        try await call("GET", "/v1/jobs/\(job.id)/results/\(name)").0.write(to: file)
    }

    /// The id of the finished upload. Keep `place` across launches of the app to go on with the same one.
    func upload(_ scan: URL, place kept: String? = nil) async throws -> String {
        let file = try FileHandle(forReadingFrom: scan)
        defer { try? file.close() }
        let size = try file.seekToEnd()
        let name = Data(scan.lastPathComponent.utf8).base64EncodedString()
        let place: String
        if let kept {
            place = kept
        } else {
            let headers = ["Upload-Length": "\(size)", "Upload-Metadata": "filename \(name)"]
            place = try await call("POST", "/v1/uploads", headers).1.value(forHTTPHeaderField: "Location")!
        }
        var failures = 0
        while true {
            do {
                let held = try await call("HEAD", place).1
                var offset = UInt64(held.value(forHTTPHeaderField: "Upload-Offset")!)!
                while offset < size {
                    try file.seek(toOffset: offset)
                    let bytes = try file.read(upToCount: piece) ?? Data()
                    let headers = ["Upload-Offset": "\(offset)", "Content-Type": "application/offset+octet-stream"]
                    let sent = try await call("PATCH", place, headers, bytes).1
                    offset = UInt64(sent.value(forHTTPHeaderField: "Upload-Offset")!)!
                    failures = 0
                }
                return place.split(separator: "/").last.map(String.init)!
            } catch is URLError where failures < 6 {  // the server is asked how far it came
                failures += 1
                try await Task.sleep(nanoseconds: UInt64(1 << failures) * 1_000_000_000)
            }
        }
    }

    @discardableResult
    private func call(_ method: String, _ path: String, _ headers: [String: String] = [:], _ body: Data? = nil)
        async throws -> (Data, HTTPURLResponse)
    {
        var request = URLRequest(url: URL(string: path, relativeTo: server)!)
        request.httpMethod = method
        request.httpBody = body
        request.setValue("Bearer \(key)", forHTTPHeaderField: "Authorization")
        request.setValue("1.0.0", forHTTPHeaderField: "Tus-Resumable")
        headers.forEach { request.setValue($1, forHTTPHeaderField: $0) }
        let (data, response) = try await URLSession.shared.data(for: request)
        let answer = response as! HTTPURLResponse
        guard answer.statusCode < 400 else { throw try JSONDecoder().decode(Refused.self, from: data) }
        return (data, answer)
    }
}
