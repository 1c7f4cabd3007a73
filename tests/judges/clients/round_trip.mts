// Uses a service with openapi-fetch and the types that openapi-typescript generates: upload, calibration, measurement, job,
// wait, result.
//
//   node round_trip.mjs ADDRESS TOKEN MASKS MEASUREMENT    NODE_EXTRA_CA_CERTS names the authority of HTTPS
//
// The result is written to standard output.

import { readFileSync } from "node:fs";
import process from "node:process";

import createClient from "openapi-fetch";

import type { paths } from "./api.js";

const [baseUrl, token, ...files] = process.argv.slice(2);
const client = createClient<paths>({ baseUrl, headers: { Authorization: `Bearer ${token}` } });

/** The content of an answer that is no problem. */
function done<Data>({ data, error }: { data?: Data; error?: unknown }): Data {
  if (data === undefined) throw new Error(`refused: ${JSON.stringify(error)}`);
  return data;
}

async function upload(file: string): Promise<string> {
  const answer = await client.POST("/v1/blobs", {
    // The types describe the fields of a form. The raw bytes are sent in their place.
    body: { file },
    bodySerializer: () => new Uint8Array(readFileSync(file)),
    headers: { "Content-Type": "application/octet-stream" },
  });
  return done(answer).sha256;
}

const wait = { header: { Prefer: "wait=20" } };
const [masks, data] = [await upload(files[0]), await upload(files[1])];
const calibration = done(await client.POST("/v1/calibrations", { params: wait, body: { masks } })).id;
const measured = await client.POST("/v1/measurements", { params: wait, body: { calibration, data } });
const request = { measurement: done(measured).id, algorithm: "gap-tv" as const };
let job = done(await client.POST("/v1/jobs", { body: request }));
while (job.state === "queued" || job.state === "running") {
  job = done(await client.GET("/v1/jobs/{job}", { params: { ...wait, path: { job: job.id } } }));
}
if (job.state !== "succeeded") throw new Error(`the job is ${job.state}: ${job.error}`);
const result = await client.GET("/v1/jobs/{job}/snapshots/{snapshot}/exports/{format}", {
  params: { path: { job: job.id, snapshot: 0, format: "npy" } },
  parseAs: "arrayBuffer",
});
process.stdout.write(new Uint8Array(done(result) as ArrayBuffer));
