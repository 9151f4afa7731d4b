// The line to the rig: one message at a time, answered once it is on the screen.

const RETRY_MS = [300, 600, 1000, 2000];
const DEAD_MS = 3500; // the rig sends something every second

/**
 * Keep a connection open for good.
 *
 * @param {(state: object, picture: Blob|null) => Promise<void>} onState shows an update
 * @param {(isOpen: boolean, isRefused: boolean) => void} onLine is told when the line opens and when it is lost
 * @param {(ageS: number|null) => void} onBeat is told that nothing is new, and for how long
 * @returns {(name: string) => void} asks for a capture to be taken back
 */
export function connect(onState, onLine, onBeat) {
  let tries = 0;
  let socket = null;
  let lastHeard = 0;

  function open() {
    const line = new WebSocket(`${location.protocol === "https:" ? "wss" : "ws"}://${location.host}/live`);
    line.binaryType = "blob";
    socket = line;
    lastHeard = performance.now();
    let waiting = null;
    line.onopen = () => {
      tries = 0;
      onLine(true, false);
    };
    line.onmessage = async ({ data }) => {
      lastHeard = performance.now();
      const isPicture = typeof data !== "string";
      const message = isPicture ? waiting : JSON.parse(data);
      if (!isPicture && message.drawing?.has_picture) {
        waiting = message;
        return;
      }
      if (message.beat) onBeat(message.age_s);
      else await onState(message, isPicture ? data : null).catch((error) => console.error(error));
      if (line.readyState === WebSocket.OPEN) line.send(JSON.stringify({ visible: !document.hidden }));
    };
    line.onclose = () => socket === line && lost();
  }

  async function lost() {
    socket = null;
    onLine(false, false);
    const wait = RETRY_MS[Math.min(tries, RETRY_MS.length - 1)];
    tries += 1;
    await new Promise((done) => setTimeout(done, wait));
    if (tries > 2 && (await isRefused())) onLine(false, true);
    open();
  }

  // A line that was cut without a goodbye stays silent; closing it would wait for the other end.
  setInterval(() => {
    if (socket !== null && performance.now() - lastHeard > DEAD_MS) {
      const line = socket;
      line.onclose = line.onmessage = line.onopen = null;
      line.close();
      lost();
    }
  }, 500);
  open();
  return (name) => {
    if (socket !== null && socket.readyState === WebSocket.OPEN) {
      socket.send(JSON.stringify({ take_back: name }));
    }
  };
}

// A new collection has a new token: this page's link is then no good any more.
async function isRefused() {
  try {
    return (await fetch("icon.svg", { cache: "no-store" })).status === 403;
  } catch {
    return false;
  }
}
