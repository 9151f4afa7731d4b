// Instruction, captures, bars, streams and messages.

const byId = (id) => document.getElementById(id);

const PHASES = {
  starting: "starting",
  searching: "looking for the board",
  moving: "move",
  holding: "hold still",
  saving: "saving",
  refused: "not here",
  enough: "enough",
  lost: "sensor lost",
  ended: "ended",
};
const COVERAGE = ["left_right", "up_down", "near_far", "tilt", "roll"];
const SMALLEST_PX = 14;

let fitted = "";

/** Show all of a state but its picture. */
export function showPanels(state) {
  document.body.dataset.phase = state.phase;
  setText("phase", PHASES[state.phase] ?? state.phase);
  setText("rig", `${state.rig} · ${state.session.split("/").pop()}`);
  byId("rig").title = state.session;
  setText("elapsed", clock(state.elapsed_s ?? 0));
  setText("detail", state.detail);
  showHeadline(state.headline);
  showCaptures(state.n_captures, state.n_wanted);
  showTakeBack(state.last_capture);
  showSigma("rotation", state.sigma_deg, state.target_deg, "°");
  showSigma("translation", state.sigma_mm, state.target_mm, " mm");
  setText("goes_on", state.goes_on);
  byId("coverage").hidden = state.coverage === null;
  if (state.coverage !== null) COVERAGE.forEach((name) => fillBar(byId(name), state.coverage[name]));
  byId("streams").replaceChildren(...state.streams.map(streamLine));
  setList("notes", state.notes);
  // The newest first: where room is short, old ones are cut off.
  setList("log", [...state.log].reverse());
}

/** Show that the line is open, and nothing has come yet. */
export function showWaiting() {
  setText("phase", "connected");
  showHeadline("waiting for the collection");
}

/** Make the headline as large as its place allows. */
export function fitHeadline() {
  const box = byId("headline");
  const text = box.firstElementChild;
  if (text === null || box.clientHeight === 0) return;
  const key = `${text.textContent} ${box.clientWidth} ${box.clientHeight}`;
  if (key === fitted) return;
  fitted = key;
  let low = SMALLEST_PX;
  let high = Math.max(low, Math.min(box.clientHeight, innerWidth / 5));
  const fits = (px) => {
    text.style.fontSize = `${px}px`;
    const width = Math.max(text.offsetWidth, text.scrollWidth);
    return text.offsetHeight <= box.clientHeight && width <= box.clientWidth;
  };
  // Words stay whole, but one that is wider than the place even when it is small.
  text.style.overflowWrap = "normal";
  if (!fits(low)) text.style.overflowWrap = "anywhere";
  if (!fits(high)) {
    while (high - low > 1) {
      const middle = (low + high) / 2;
      if (fits(middle)) low = middle;
      else high = middle;
    }
    fits(low);
  }
}

function showHeadline(words) {
  const box = byId("headline");
  if (box.firstElementChild === null) box.replaceChildren(document.createElement("span"));
  // A figure and its unit stay on one line.
  words = words.replace(/(\d) (?=[a-zµ°%]{1,2}\b)/g, "$1\u00a0");
  if (box.firstElementChild.textContent !== words) box.firstElementChild.textContent = words;
  fitHeadline();
}

function showCaptures(count, wanted) {
  const before = byId("count").textContent;
  setText("count", String(count));
  setText("captures_word", (wanted ?? count) === 1 ? "capture" : "captures");
  setText("of", wanted === null ? "" : `of ${wanted}`);
  if (count > Number(before)) {
    const box = byId("captures");
    box.classList.remove("new");
    void box.offsetWidth; // begins the flash anew
    box.classList.add("new");
  }
}

// The button names the capture that it takes back: one that came since stays.
function showTakeBack(name) {
  const button = byId("take_back");
  button.hidden = name === "";
  button.dataset.capture = name;
  setText("take_back", `take back\n${name}`);
}

function showSigma(id, sigma, target, unit) {
  const bar = byId(id);
  const now = sigma === null ? "–" : `${digits(sigma)}${unit}`;
  const figure = bar.querySelector("b");
  const wanted = target === null ? "" : ` / ${digits(target)}`;
  if (figure.textContent !== now + wanted) {
    const small = document.createElement("small");
    small.textContent = wanted;
    figure.replaceChildren(now, small);
  }
  fillBar(bar, sigma === null || target === null ? 0 : sigma > 0 ? target / sigma : 1);
}

function fillBar(bar, share) {
  bar.classList.toggle("full", share >= 0.995);
  bar.querySelector("em").style.transform = `scaleX(${Math.min(Math.max(share, 0), 1)})`;
}

function streamLine(stream) {
  const line = document.createElement("li");
  const isBad = stream.reason !== "" || stream.sees_board === false;
  line.className = isBad ? "bad" : stream.sees_board === null ? "" : "good";
  const figures = [stream.figures, `${digits(stream.rate_hz ?? 0)} Hz`];
  if (stream.n_lost > 0) figures.push(`${stream.n_lost} lost`);
  line.append(
    part("name", stream.name),
    part("figures", figures.filter((each) => each !== "").join(" · ")),
    part("reason", stream.reason),
  );
  return line;
}

function part(kind, text) {
  const element = document.createElement("span");
  element.className = kind;
  element.textContent = text;
  return element;
}

function setText(id, text) {
  const element = byId(id);
  if (element.textContent !== text) element.textContent = text;
}

function setList(id, lines) {
  const list = byId(id);
  const key = JSON.stringify(lines);
  if (list.dataset.shown === key) return;
  list.dataset.shown = key;
  list.replaceChildren(...lines.map((line) => Object.assign(document.createElement("li"), { textContent: line })));
}

function digits(value) {
  if (value === 0 || value >= 9.95) return value.toFixed(0);
  return value.toFixed(value >= 0.995 ? 1 : 2);
}

function clock(seconds) {
  const whole = Math.floor(seconds);
  const parts = [Math.floor(whole / 60) % 60, whole % 60].map((each) => String(each).padStart(2, "0"));
  return (whole >= 3600 ? `${Math.floor(whole / 3600)}:` : "") + parts.join(":");
}
