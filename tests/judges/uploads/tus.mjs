// Uploads a file with tus-js-client. Usage: node tus.mjs ENDPOINT TOKEN FILE. Prints the address of the upload.

import { readFileSync } from "node:fs";
import { Upload } from "tus-js-client";

const [endpoint, token, file] = process.argv.slice(2);
const upload = new Upload(readFileSync(file), {
  endpoint,
  headers: { Authorization: `Bearer ${token}` },
  chunkSize: 16384,
  metadata: { filename: "masks.npy" },
  onError(error) {
    console.error(String(error));
    process.exit(1);
  },
  onSuccess: () => console.log(upload.url),
});
upload.start();
