// The live picture, and where the board is and should be in it.

const SVG = "http://www.w3.org/2000/svg";
const byId = (id) => document.getElementById(id);

const picture = byId("picture");
const outlines = byId("outlines");
let fullHoldS = 0;

/** Show a drawing and, where it brought one, its picture. */
export async function showDrawing(drawing, jpeg) {
  if (jpeg !== null) {
    const bitmap = await createImageBitmap(jpeg);
    picture.width = bitmap.width;
    picture.height = bitmap.height;
    picture.getContext("2d", { alpha: false }).drawImage(bitmap, 0, 0);
    bitmap.close();
    picture.classList.remove("blank");
    byId("nothing").hidden = true;
  }
  if (drawing === null) {
    picture.classList.add("blank");
    byId("nothing").hidden = false;
  } else {
    byId("stage").style.setProperty("--aspect", `${drawing.width_px} / ${drawing.height_px}`);
    // Pixel centres lie at integers.
    outlines.setAttribute("viewBox", `-0.5 -0.5 ${drawing.width_px} ${drawing.height_px}`);
    outlines.classList.toggle("there", drawing.is_there);
    byId("legend").hidden = drawing.is_there;
    keepClear(centre(drawing.present_px), drawing.width_px);
  }
  byId("camera").textContent = drawing?.camera ?? "";
  drawOutline("present", drawing?.present_px ?? null);
  drawOutline("wanted", drawing?.wanted_px ?? null);
  drawArrow(drawing);
}

/** Show how long the board has still to be held, as a ring that empties; null where it is not held. */
export function showHold(holdS) {
  byId("countdown").hidden = holdS === null;
  fullHoldS = holdS === null ? 0 : Math.max(fullHoldS, holdS);
  if (holdS === null) return;
  byId("hold").textContent = String(Math.ceil(holdS));
  byId("ring").style.strokeDashoffset = String(1 - (fullHoldS > 0 ? holdS / fullHoldS : 0));
}

/** Show the picture as in a mirror, so that left on the screen is left of whoever faces the rig. */
export function setMirrored(isMirrored) {
  byId("scene").classList.toggle("mirrored", isMirrored);
}

// The countdown stands where the board is not.
function keepClear(board, width) {
  const isRight = board !== null && board[0] > width / 2;
  byId("countdown").classList.toggle("left", isRight !== byId("scene").classList.contains("mirrored"));
}

function drawOutline(id, points) {
  const lines = points === null ? "" : toPath(points);
  byId(id).replaceChildren(...(lines === "" ? [] : [path("halo", lines), path("ink", lines)]));
  document.querySelector(`#legend .${id}`).classList.toggle("drawn", lines !== "");
}

// Points out of the lens's sight are null: the line breaks there.
function toPath(points) {
  let pen = "M";
  let lines = "";
  for (const point of points) {
    if (point === null) {
      pen = "M";
      continue;
    }
    lines += `${pen}${point[0]} ${point[1]}`;
    pen = "L";
  }
  return lines;
}

// From the middle of the board to the border of its place, which stays visible; to its middle where both overlap.
function drawArrow(drawing) {
  const from = centre(drawing?.present_px);
  const middle = centre(drawing?.wanted_px);
  const parts = [];
  if (from !== null && middle !== null && !drawing.is_there) {
    const head = 0.03 * drawing.width_px;
    const border = crossing(from, middle, drawing.wanted_px);
    const to = border !== null && distance(from, border) > 0.5 * distance(from, middle) ? border : middle;
    const length = distance(from, to);
    if (length > 1.5 * head) {
      const [ux, uy] = [(to[0] - from[0]) / length, (to[1] - from[1]) / length];
      const neck = [to[0] - head * ux, to[1] - head * uy];
      const shaft = `M${from[0]} ${from[1]}L${neck[0]} ${neck[1]}`;
      const side = 0.6 * head;
      const tip = `M${to[0]} ${to[1]}L${neck[0] - side * uy} ${neck[1] + side * ux}L${neck[0] + side * uy} ${neck[1] - side * ux}Z`;
      parts.push(path("halo", shaft), path("ink", shaft), path("head", tip));
    }
  }
  byId("arrow").replaceChildren(...parts);
}

// Where the way from a point to an outline's middle first meets the outline; null where it does not.
function crossing(from, middle, points) {
  const way = [middle[0] - from[0], middle[1] - from[1]];
  let first = 1;
  for (let k = 1; k < points.length; k += 1) {
    const [a, b] = [points[k - 1], points[k]];
    if (a === null || b === null) continue;
    const edge = [b[0] - a[0], b[1] - a[1]];
    const cross = way[0] * edge[1] - way[1] * edge[0];
    const gap = [a[0] - from[0], a[1] - from[1]];
    const along = (gap[0] * edge[1] - gap[1] * edge[0]) / cross;
    const across = (gap[0] * way[1] - gap[1] * way[0]) / cross;
    if (along > 0 && along < first && across >= 0 && across <= 1) first = along;
  }
  return first < 1 ? [from[0] + first * way[0], from[1] + first * way[1]] : null;
}

function distance(a, b) {
  return Math.hypot(a[0] - b[0], a[1] - b[1]);
}

function centre(points) {
  // The last point repeats the first.
  const seen = (points ?? []).slice(0, -1).filter((point) => point !== null);
  if (seen.length === 0) return null;
  const sum = seen.reduce((total, point) => [total[0] + point[0], total[1] + point[1]], [0, 0]);
  return [sum[0] / seen.length, sum[1] / seen.length];
}

function path(kind, lines) {
  const element = document.createElementNS(SVG, "path");
  element.setAttribute("class", kind);
  element.setAttribute("d", lines);
  return element;
}
