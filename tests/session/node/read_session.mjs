// Reads a session file with the reference MCAP implementation in TypeScript, by its index and every
// checksum, and prints what it found: per topic the number of messages and, of the numbers in them,
// the first and the last message and the sums.
import { open } from "node:fs/promises";
import { McapIndexedReader, McapStreamReader } from "@mcap/core";
import { FileHandleReadable } from "@mcap/nodejs";
import { loadDecompressHandlers } from "@mcap/support";
import protobufjs from "protobufjs";
import descriptor from "protobufjs/ext/descriptor/index.js";

const plain = (message) =>
  Object.fromEntries(
    Object.entries(message).map(([name, value]) => [
      name,
      protobufjs.util.Long.isLong(value) ? Number(value) : value,
    ]),
  );

const file = await open(process.argv[2], "r");
const decompressHandlers = await loadDecompressHandlers();
const reader = await McapIndexedReader.Initialize({
  readable: new FileHandleReadable(file),
  decompressHandlers,
});

const types = new Map();
for (const channel of reader.channelsById.values()) {
  const schema = reader.schemasById.get(channel.schemaId);
  const set = descriptor.FileDescriptorSet.decode(schema.data);
  types.set(channel.id, protobufjs.Root.fromDescriptor(set).lookupType(schema.name));
}

const topics = {};
for await (const record of reader.readMessages()) {
  const { topic } = reader.channelsById.get(record.channelId);
  const message = types.get(record.channelId).decode(record.data);
  const found = (topics[topic] ??= { count: 0, sums: {} });
  const values = plain(message);
  for (const [name, value] of Object.entries(values)) {
    if (typeof value === "number") {
      found.sums[name] = (found.sums[name] ?? 0) + value;
    }
  }
  found.count += 1;
  found.first ??= values;
  found.last = values;
}

const metadata = {};
for await (const record of reader.readMetadata()) {
  metadata[record.name] = Object.fromEntries(record.metadata);
}
const attachments = {};
for await (const record of reader.readAttachments()) {
  attachments[record.name] = new TextDecoder().decode(record.data);
}

// Once more from the beginning to the end, as a stream.
const stream = new McapStreamReader({ decompressHandlers, validateCrcs: true });
stream.append(await file.readFile());
let streamed = 0;
for (let record; (record = stream.nextRecord()); ) {
  streamed += record.type === "Message" ? 1 : 0;
}

const statistics = Number(reader.statistics.messageCount);
console.log(
  JSON.stringify({ topics, metadata, attachments, statistics, streamed, done: stream.done() }),
);
await file.close();
