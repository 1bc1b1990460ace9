// Send a scan from an app on Android: a resumable upload (tus 1.0.0), and a job of it. OkHttp 4 or 5, and org.json.
//
//     val job = Advtex("https://advtex.example", "adv_...").texture(file, "kitchen")      // not on the main thread

import java.io.File
import java.io.IOException
import java.io.RandomAccessFile
import java.security.MessageDigest
import java.util.Base64
import okhttp3.HttpUrl.Companion.toHttpUrl
import okhttp3.MediaType.Companion.toMediaType
import okhttp3.OkHttpClient
import okhttp3.Request
import okhttp3.RequestBody
import okhttp3.RequestBody.Companion.toRequestBody
import okhttp3.Response
import org.json.JSONObject

/** help: a path on the server that explains the code. */
class Refused(val code: String, message: String, val help: String) : Exception(message)

class Advtex(server: String, private val key: String) {
    private val http = OkHttpClient()
    private val server = server.toHttpUrl()

    /** The job; `state` goes from checking over queued and running to succeeded, failed, canceled or rejected. */
    fun texture(scan: File, label: String): JSONObject {
        val body = """{"upload_id": "${upload(scan)}", "options": {"preset": "auto"}, "label": ${JSONObject.quote(label)}}"""
        // The same key and body are the same job, however often this is sent.
        val once = MessageDigest.getInstance("SHA-256").digest(body.toByteArray()).joinToString("") { "%02x".format(it) }
        val json = body.toByteArray().toRequestBody("application/json".toMediaType())
        return call("POST", "/v1/jobs", mapOf("Idempotency-Key" to once), json).use { JSONObject(it.body!!.string()) }
    }

    fun job(id: String): JSONObject = call("GET", "/v1/jobs/$id").use { JSONObject(it.body!!.string()) }

    /** `model_mobile.glb` or `model.glb` opens in Scene Viewer. */
    fun download(job: String, name: String, file: File) {
        call("GET", "/v1/jobs/$job/results/$name").use { answer ->
            file.outputStream().use { answer.body!!.byteStream().copyTo(it) }
        }
    }

    /** The id of the finished upload. Keep [kept], its place, across starts of the app to go on with the same one. */
    fun upload(scan: File, kept: String? = null): String {
        val name = Base64.getEncoder().encodeToString(scan.name.toByteArray())
        val announced = mapOf("Upload-Length" to "${scan.length()}", "Upload-Metadata" to "filename $name")
        val place = kept ?: call("POST", "/v1/uploads", announced, EMPTY).use { it.header("Location")!! }
        var failures = 0
        while (true) {
            try {
                var offset = call("HEAD", place).use { it.header("Upload-Offset")!!.toLong() }
                while (offset < scan.length()) {
                    val headers = mapOf("Upload-Offset" to "$offset")
                    offset = call("PATCH", place, headers, piece(scan, offset).toRequestBody(OCTETS)).use { it.header("Upload-Offset")!!.toLong() }
                    failures = 0
                }
                return place.substringAfterLast('/')
            } catch (error: IOException) { // the server is asked how far it came
                if (++failures > 6) throw error
                Thread.sleep(1000L shl failures)
            }
        }
    }

    private fun piece(scan: File, offset: Long): ByteArray = RandomAccessFile(scan, "r").use {
        it.seek(offset)
        ByteArray(minOf(PIECE, scan.length() - offset).toInt()).also(it::readFully)
    }

    private fun call(method: String, path: String, headers: Map<String, String> = mapOf(), body: RequestBody? = null): Response {
        val request = Request.Builder().url(server.resolve(path)!!).method(method, body)
            .header("Authorization", "Bearer $key").header("Tus-Resumable", "1.0.0")
        headers.forEach { (name, value) -> request.header(name, value) }
        val answer = http.newCall(request.build()).execute()
        if (answer.isSuccessful) return answer
        val told = answer.use { JSONObject(it.body!!.string().ifEmpty { "{}" }) }
        throw Refused(told.optString("code"), told.optString("message", "HTTP ${answer.code}"), told.optString("help"))
    }

    private companion object {
        const val PIECE = 4L shl 20 // bytes per request: after each, the server has them for good
        val OCTETS = "application/offset+octet-stream".toMediaType()
        val EMPTY = ByteArray(0).toRequestBody()
    }
}
