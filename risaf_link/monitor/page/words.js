// What numbers are called, and how they are written.

export const STATES = [ // RISAF_HEADING_STATE: word, class, sign
  ["no fix", "red", "✕"], ["too slow for a heading", "amber", "…"], ["aligning", "amber", "…"],
  ["fusing", "good", "✓"], ["rejecting", "red", "✕"], ["dead reckoning", "red", "!"],
];
export const DEAD_RECKONING = 5;
export const SOURCES = ["nothing yet", "velocity", "positions", "positions, raw", "two antennas"];
export const SENSOR_STATES = ["healthy", "suspect", "dead"];
export const REJECTIONS = { unsigned: "not signed", signature: "signed with another key", replayed: "not later than the one before", late: "late", future: "from the future", streams: "of too many senders" };
export const REASONS = ["", "settling", "wandering", "outlying", "frozen", "silent"];
export const SEVERITIES = ["emergency", "alert", "critical", "error", "warning", "notice", "info", "debug"];
const AUTOPILOTS = { 3: "ArduPilot", 12: "PX4" }; // MAV_AUTOPILOT
const NO_AUTOPILOT = 8;
const TYPES = { 6: "ground station", 18: "onboard computer", 26: "gimbal", 30: "camera" }; // MAV_TYPE
const STATUS = ["", "boot", "calibrating", "standby", "active", "critical", "emergency", "powered off"];

export const deg = (rad) => rad === null || rad === undefined ? null : rad * 180 / Math.PI;
export const compassDeg = (rad) => rad === null || rad === undefined ? null : ((deg(rad) % 360) + 360) % 360;

export function number(value, digits = 0, unit = "") {
  if (value === null || value === undefined) return "–";
  const text = value.toFixed(digits);
  return (Number(text) === 0 ? text.replace("-", "") : text.replace("-", "−")) + unit;
}

export function signed(value, digits, unit = "") {
  return (Number(value?.toFixed(digits)) > 0 ? "+" : "") + number(value, digits, unit);
}

export function deviation(value, digits, unit = "") {
  return value === null || value === undefined ? "" : ` ± ${value.toFixed(digits)}${unit}`;
}

export function elapsed(seconds) {
  const s = Math.max(0, seconds), h = Math.floor(s / 3600), m = Math.floor(s / 60) % 60;
  const tail = String(Math.floor(s % 60)).padStart(2, "0");
  return h ? `${h}:${String(m).padStart(2, "0")}:${tail}` : `${m}:${tail}`;
}

// Of a log the time since it began, live the time of day.
export function timeText(us, playback) {
  return playback ? elapsed((us - playback.begin_us) / 1e6) : new Date(us / 1000).toLocaleTimeString("en-GB");
}

export function ageText(seconds) {
  return seconds < 10 ? seconds.toFixed(1) + " s" : seconds < 120 ? Math.round(seconds) + " s" : elapsed(seconds);
}

export function who(heard) {
  const p = heard.pulse;
  let kind = heard.is_estimator ? "risaf_link" : "";
  if (!kind && p) kind = p.autopilot === NO_AUTOPILOT ? TYPES[p.type] ?? "component" : AUTOPILOTS[p.autopilot] ?? "autopilot";
  const status = p && p.autopilot !== undefined ? STATUS[p.status] : "";
  return [`${heard.system}:${heard.component}`, kind, status, heard.peer].filter(Boolean);
}
