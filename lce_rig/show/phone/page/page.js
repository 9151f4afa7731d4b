// Ties the line to the rig to what is on the screen.

import { connect } from "./connection.js";
import { fitHeadline, showPanels, showWaiting } from "./panels.js";
import { play, playCues, setSound, setSpeech, speak } from "./sounds.js";
import { setMirrored, showDrawing, showHold } from "./stage.js";

const STALE_S = 3;
const byId = (id) => document.getElementById(id);

let phase = null;
let isAfterGap = false;
let wasOpen = false;

const takeBack = connect(
  async (state, picture) => {
    phase = state.phase;
    setBanner("");
    await showDrawing(state.drawing, picture);
    showPanels(state);
    showHold(state.hold_s);
    playCues(state.cues, isAfterGap);
    speak(state.headline, state.phase);
    isAfterGap = false;
    document.title = `${state.n_captures} · ${state.headline}`;
  },
  (isOpen, isRefused) => {
    const isOver = phase === "ended" && !isRefused;
    document.body.dataset.connection = isOpen ? "open" : isOver ? "over" : "lost";
    if (isRefused) setBanner("This link is no longer valid. Open the one that the rig shows now.");
    else setBanner(isOpen || isOver ? "" : "Connection to the rig lost. Trying again …");
    if (isOpen && phase === null) showWaiting();
    if (!isOpen) {
      isAfterGap = true;
      showHold(null);
      if (wasOpen && !isOver) play("lost");
    }
    wasOpen = isOpen;
  },
  (ageS) => {
    if (ageS !== null && ageS > STALE_S && phase !== "ended") {
      setBanner(`No news from the rig for ${Math.round(ageS)} s`);
    }
  },
);

function setBanner(text) {
  byId("banner").hidden = text === "";
  if (byId("banner").textContent !== text) byId("banner").textContent = text;
}

// What is chosen once stays chosen; sounds need a tap each time.
function toggle(id, isOn, choose) {
  const button = byId(id);
  const set = (on) => {
    button.setAttribute("aria-pressed", String(on));
    choose(on);
  };
  button.setAttribute("aria-pressed", String(isOn));
  button.addEventListener("click", () => set(button.getAttribute("aria-pressed") !== "true"));
  return set;
}

byId("take_back").addEventListener("click", () => takeBack(byId("take_back").dataset.capture));

toggle("sound", false, setSound);

if ("speechSynthesis" in window) {
  toggle("speech", false, setSpeech);
  const offer = () => (byId("speech").hidden = speechSynthesis.getVoices().length === 0);
  speechSynthesis.addEventListener("voiceschanged", offer);
  offer();
}

// Browsers that keep nothing of a page refuse their storage.
function remembered(name) {
  try {
    return localStorage.getItem(name);
  } catch {
    return null;
  }
}

function remember(name, value) {
  try {
    localStorage.setItem(name, value);
  } catch {
    // chosen anew next time
  }
}

const isMirrored = remembered("mirror") !== "no";
toggle("mirror", isMirrored, (on) => {
  remember("mirror", on ? "yes" : "no");
  setMirrored(on);
});
setMirrored(isMirrored);

if (document.fullscreenEnabled) {
  const button = byId("fullscreen");
  button.hidden = false;
  button.addEventListener("click", () => {
    if (document.fullscreenElement === null) document.documentElement.requestFullscreen();
    else document.exitFullscreen();
  });
  document.addEventListener("fullscreenchange", () =>
    button.setAttribute("aria-pressed", String(document.fullscreenElement !== null)),
  );
}

// Browsers let only pages from this computer, or encrypted ones, keep the screen on.
byId("hint").hidden = "wakeLock" in navigator || !matchMedia("(pointer: coarse)").matches;

async function keepScreenOn() {
  if (document.hidden || !("wakeLock" in navigator)) return;
  try {
    await navigator.wakeLock.request("screen");
  } catch {
    // The battery is low, or the system says no: the screen follows the phone's own setting.
  }
}
document.addEventListener("visibilitychange", keepScreenOn);
keepScreenOn();

new ResizeObserver(fitHeadline).observe(byId("headline"));
