// node upload.cjs ENDPOINT KEY FILE CHUNK [URL]: uploads FILE, prints the upload's URL and the offsets that were accepted
const fs = require("node:fs");
const tus = require("tus-js-client");

const [endpoint, key, path, chunk, url] = process.argv.slice(2);
const accepted = [];
const upload = new tus.Upload(fs.createReadStream(path), {
  endpoint,
  uploadUrl: url || null,
  uploadSize: fs.statSync(path).size,
  chunkSize: Number(chunk),
  uploadDataDuringCreation: url === undefined,
  retryDelays: [0, 100, 500],
  headers: { Authorization: `Bearer ${key}` },
  metadata: { filename: "scän.zip" },
  onChunkComplete: (_size, offset) => accepted.push(offset),
  onError: (error) => {
    console.error(String(error));
    process.exit(1);
  },
  onSuccess: () => console.log(JSON.stringify({ url: upload.url, accepted })),
});
upload.start();
