/* A ground station by node-mavlink, as a process of its own.
 *
 *     node_client.js PORT RATE_HZ [KEY]
 *
 * With a key, 64 hexadecimal digits, it signs what it sends, and counts what is not signed with it.
 * Waits for the component and asks it for everything; what came of it goes to standard output as
 * JSON. Whatever is not answered is asked again, as on a link that loses frames.
 */
"use strict";

const dgram = require("node:dgram");
const {
  MavLinkPacketParser,
  MavLinkPacketSplitter,
  MavLinkProtocolV2,
  common,
  minimal,
} = require("node-mavlink");

const DEADLINE_MS = 60000;
const AGAIN_MS = 500;
const COMPONENT = 191;
const REGISTRY = { ...minimal.REGISTRY, ...common.REGISTRY };
const [QUATERNION, QUATERNION_COV, INTERVAL, UNKNOWN_MESSAGE] = [31, 61, 244, 24];
const [GET_INTERVAL_OF, SET_INTERVAL, STORAGE, REQUEST, UNKNOWN_COMMAND] = [244, 511, 245, 512, 400];
const IN_PROGRESS = 5;
const REAL32 = 9;

class Station {
  constructor(port, key) {
    this.key = key && Buffer.from(key, "hex");
    this.protocol = new MavLinkProtocolV2(
      255, 190, this.key ? MavLinkProtocolV2.IFLAG_SIGNED : 0);
    this.counts = { frames: 0, checksums: 0, signatures: 0, spoiled: 0 };
    this.system = 0;
    this.sequence = 0;
    this.signedAt = 0;
    this.listeners = new Set();
    const splitter = new MavLinkPacketSplitter({}, { onCrcError: () => this.counts.checksums++ });
    splitter.pipe(new MavLinkPacketParser()).on("data", (packet) => this.take(packet));
    this.socket = dgram.createSocket("udp4");
    this.socket.on("message", (datagram) => splitter.write(datagram));
    this.socket.on("error", () => {}); // nobody is there yet
    this.socket.connect(port, "127.0.0.1", () => {
      const beat = new minimal.Heartbeat();
      Object.assign(beat, { type: 6, autopilot: 8, systemStatus: 4, mavlinkVersion: 3 });
      this.send(beat);
      setInterval(() => this.send(beat), 500);
    });
  }

  take(packet) {
    const kind = REGISTRY[packet.header.msgid];
    if (packet.header.compid !== COMPONENT || !kind) return;
    this.counts.frames++;
    if (this.key && !(packet.signature && packet.signature.matches(this.key))) {
      this.counts.signatures++;
    }
    const message = packet.protocol.data(packet.payload, kind);
    for (const listener of this.listeners) listener(message, packet);
  }

  send(message) {
    const raw = this.protocol.serialize(message, this.sequence++ % 256);
    if (!this.key) return this.socket.send(raw);
    this.signedAt = Math.max(Date.now(), this.signedAt + 1); // a stamp is used once
    return this.socket.send(this.protocol.sign(raw, 7, this.key, this.signedAt));
  }

  /* A message, made to be sent to the component. */
  to(Kind, fields) {
    const us = { targetSystem: this.system, targetComponent: COMPONENT };
    return Object.assign(new Kind(), us, fields);
  }

  /* The next message of a kind that is wanted, and its packet; null: none came in time. */
  next(Kind, isWanted = () => true, waitMs = AGAIN_MS) {
    return new Promise((resolve) => {
      const end = (found) => {
        clearTimeout(timer);
        this.listeners.delete(listener);
        resolve(found);
      };
      const listener = (message, packet) => {
        if (message instanceof Kind && isWanted(message)) end([message, packet]);
      };
      const timer = setTimeout(() => end(null), waitMs);
      this.listeners.add(listener);
    });
  }

  async answer(asked, Kind, isWanted) {
    for (;;) {
      const coming = this.next(Kind, isWanted);
      this.send(asked);
      const found = await coming;
      if (found) return found[0];
    }
  }

  async wait() {
    for (;;) {
      const found = await this.next(minimal.Heartbeat, (beat) => beat.systemStatus === 4);
      if (!found) continue;
      const [beat, packet] = found;
      this.system = packet.header.sysid;
      const spoiled = Buffer.from(packet.buffer);
      spoiled[12] ^= 1;
      // Once: behind it a byte of the signature may look like the start of another frame.
      const splitter = new MavLinkPacketSplitter({}, { onCrcError: () => (this.counts.spoiled = 1) });
      splitter.write(spoiled);
      return { type: beat.type, autopilot: beat.autopilot };
    }
  }

  /* As ground stations do: the list, then what is missing, one by one. */
  async parameters() {
    const found = new Map();
    let count = Infinity;
    const listener = (message) => {
      if (!(message instanceof common.ParamValue)) return;
      found.set(message.paramIndex, message);
      count = message.paramCount;
    };
    this.listeners.add(listener);
    this.send(this.to(common.ParamRequestList));
    while (await this.next(common.ParamValue)) if (found.size >= count) break;
    while (found.size < count) {
      if (count === Infinity) this.send(this.to(common.ParamRequestList));
      for (let i = 0; i < (count === Infinity ? 0 : count); i++) {
        if (!found.has(i)) {
          this.send(this.to(common.ParamRequestRead, { paramId: "", paramIndex: i }));
        }
      }
      while (await this.next(common.ParamValue)) if (found.size >= count) break;
    }
    this.listeners.delete(listener);
    return Object.fromEntries([...found.values()].map((each) => [each.paramId, each.paramValue]));
  }

  async set(name, value) {
    const fields = { paramId: name, paramValue: value, paramType: REAL32 };
    const asked = this.to(common.ParamSet, fields);
    return (await this.answer(asked, common.ParamValue, (m) => m.paramId === name)).paramValue;
  }

  /* The results that are acknowledged, up to the last one. */
  async command(command, ...values) {
    const results = new Set();
    for (let confirmation = 0; ; confirmation++) {
      this.send(this.order(command, values, confirmation));
      for (;;) {
        const found = await this.next(common.CommandAck, (ack) => ack.command === command);
        if (!found) break;
        results.add(found[0].result);
        if (found[0].result !== IN_PROGRESS) return [...results];
      }
    }
  }

  async request(id, Kind, second = 0) {
    return this.answer(this.order(REQUEST, [id, second], 0), Kind);
  }

  order(command, values, confirmation) {
    const fields = { command, confirmation };
    for (let i = 0; i < 7; i++) fields[`_param${i + 1}`] = values[i] ?? 0;
    return this.to(common.CommandLong, fields);
  }

  /* Between so many attitudes, by their own time. */
  async periodsMs(count) {
    const times = [];
    while (times.length <= count) {
      const found = await this.next(common.AttitudeQuaternion, () => true, 5000);
      if (found) times.push(found[0].timeBootMs);
    }
    times.sort((a, b) => a - b);
    return times.slice(1).map((time, i) => time - times[i]);
  }
}

async function main(port, rate, key) {
  setTimeout(() => {
    console.error("no answer before the deadline");
    process.exit(1);
  }, DEADLINE_MS);
  const station = new Station(Number(port), key);
  const found = { heartbeat: await station.wait() };
  found.interval = await station.command(SET_INTERVAL, QUATERNION, 1e6 / Number(rate));
  const interval = await station.request(GET_INTERVAL_OF, common.MessageInterval, QUATERNION);
  found.told_interval = interval.intervalUs;
  found.parameters = await station.parameters();
  found.set = await station.set("HDG_GATE", 4.5);
  found.refused = await station.set("HDG_GATE", -1);
  found.no_message = await station.command(SET_INTERVAL, UNKNOWN_MESSAGE, 1e6);
  found.no_command = await station.command(UNKNOWN_COMMAND);
  found.stored = await station.command(STORAGE, 1);
  const attitude = await station.request(QUATERNION, common.AttitudeQuaternion);
  found.attitude = [attitude.q1, attitude.q2, attitude.q3, attitude.q4];
  const uncertain = await station.request(QUATERNION_COV, common.AttitudeQuaternionCov);
  found.attitude_cov = uncertain.q;
  found.covariance = uncertain.covariance;
  found.periods_ms = await station.periodsMs(15);
  found.counts = station.counts;
  process.stdout.write(`${JSON.stringify(found)}\n`, () => process.exit(0));
}

main(...process.argv.slice(2));
