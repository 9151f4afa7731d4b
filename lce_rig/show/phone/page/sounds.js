// Sounds and voice, for whoever cannot look at the screen. Browsers allow neither before a tap.

// [frequency in Hz, begin in s, length in s]
const TONES = {
  tick: [[1000, 0, 0.05]],
  captured: [[880, 0, 0.1], [1320, 0.1, 0.22]],
  taken_back: [[1320, 0, 0.1], [880, 0.1, 0.1], [587, 0.2, 0.2]],
  refused: [[220, 0, 0.16], [185, 0.22, 0.26]],
  enough: [[660, 0, 0.14], [830, 0.14, 0.14], [990, 0.28, 0.14], [1320, 0.42, 0.5]],
  lost: [[880, 0, 0.2], [587, 0.22, 0.2], [440, 0.44, 0.5]],
};
const HARSH = new Set(["refused", "lost"]);
// The words must have stood for so long: they change while the board moves.
const SETTLED_MS = 700;
const QUIET_PHASES = new Set(["holding", "saving"]);

let context = null;
let isOn = false;
let lastCue = null;
let busyUntil = 0;
let speaks = false;
let spoken = "";
let settling = { words: "", since: 0 };

/** Turn sounds on or off; must be called from a tap. */
export async function setSound(on) {
  isOn = on;
  if (!on) return;
  context ??= new AudioContext();
  await context.resume();
  play("tick");
}

/** Turn the voice on or off; must be called from a tap. */
export function setSpeech(on) {
  speaks = on;
  spoken = "";
  speechSynthesis.cancel();
}

/** Play what has come since the last call; after a gap, only the newest. */
export function playCues(cues, isAfterGap) {
  if (cues.length === 0) return;
  const newest = cues[cues.length - 1].number;
  // A page that was just opened has missed nothing, and a new collection counts from the start.
  if (lastCue !== null && newest >= lastCue) {
    const fresh = cues.filter((cue) => cue.number > lastCue);
    (isAfterGap ? fresh.slice(-1) : fresh).forEach((cue) => play(cue.sound));
  }
  lastCue = newest;
}

/** Play one sound, after those that are still playing. */
export function play(sound) {
  const tones = TONES[sound];
  if (!isOn || tones === undefined || context.state !== "running") return;
  const begin = Math.max(context.currentTime + 0.02, busyUntil);
  for (const [frequency, after, length] of tones) tone(frequency, begin + after, length, HARSH.has(sound));
  const [, after, length] = tones[tones.length - 1];
  busyUntil = begin + after + length + 0.05;
}

/** Read a headline aloud once it has settled; one is finished before the next begins. */
export function speak(headline, phase) {
  const now = performance.now();
  if (settling.words !== headline) settling = { words: headline, since: now };
  if (!speaks || QUIET_PHASES.has(phase) || headline === spoken || speechSynthesis.speaking) return;
  if (now - settling.since < SETTLED_MS) return;
  spoken = headline;
  const words = new SpeechSynthesisUtterance(headline);
  words.lang = "en";
  // Voices of a distant service do not work without a network.
  words.voice = speechSynthesis.getVoices().find((each) => each.localService && each.lang.startsWith("en")) ?? null;
  speechSynthesis.speak(words);
}

function tone(frequency, begin, length, isHarsh) {
  const source = context.createOscillator();
  const volume = context.createGain();
  source.type = isHarsh ? "square" : "triangle";
  source.frequency.value = frequency;
  // Without a ramp the ends click.
  volume.gain.setValueAtTime(0, begin);
  volume.gain.linearRampToValueAtTime(isHarsh ? 0.35 : 0.8, begin + 0.008);
  volume.gain.setValueAtTime(isHarsh ? 0.35 : 0.8, begin + length - 0.02);
  volume.gain.linearRampToValueAtTime(0, begin + length);
  source.connect(volume).connect(context.destination);
  source.start(begin);
  source.stop(begin + length + 0.02);
}
