"use strict";
// What replays draw. Every name goes through textContent, none is parsed.

const ACTIONS = ["move ahead", "turn left", "turn right", "look up", "look down", "Done"];
const DONE = 5;
const KINDS = ["factual", "counterfactual", "corrected"];

function element(name, properties = {}, ...children) {
  const made = Object.assign(document.createElement(name), properties);
  made.append(...children);
  return made;
}

function shape(name, attributes = {}, ...children) {
  const made = document.createElementNS("http://www.w3.org/2000/svg", name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  made.append(...children);
  return made;
}

// A word that opens its definition of the glossary.

function term(word, key) {
  const button = element("button", { type: "button", className: "term" }, word);
  button.setAttribute("popovertarget", `about-${key}`);
  return button;
}

const unpack = (text) => Float64Array.from(atob(text), (byte) => byte.charCodeAt(0) / 255);
const rectangle = ([x, z, width, height], kind) => shape("rect", { x, y: -z - height, width, height, class: kind });

// The plan: y is -z, so that z points up; lengths are centimetres.

function drawPlan(plan, categories, goal) {
  const [x, z, width, height] = plan.box, unit = Math.max(width, height) / 100, edge = 4 * unit;
  const drawing = shape("svg", {
    class: "plan", viewBox: [x - edge, -z - height - edge, width + 2 * edge, height + 2 * edge].join(" "),
    "font-size": 2.9 * unit, role: "img", "aria-label": `Plan of ${plan.name}`,
  });
  plan.floors.forEach((floor, tint) => {
    const cells = floor.cells.map((cell) => rectangle(cell, "floor"));
    if (floor.name) cells.forEach((cell) => (cell.style.fill = `var(--tint-${((tint - 1) % 6) + 1})`));
    drawing.append(...cells);
  });
  drawing.append(...plan.walls.map((wall) => rectangle(wall, "wall")));
  for (const [bx, bz, w, d, tall] of plan.furniture) {
    const box = rectangle([bx, bz, w, d], "furniture");
    box.style.fill = `color-mix(in srgb, var(--high) ${tall}%, var(--low))`;
    box.setAttribute("stroke-width", 0.25 * unit);
    drawing.append(box);
  }
  for (const floor of plan.floors) if (floor.name) drawing.append(roomName(floor));
  const heat = shape("g", { class: "heat" });
  drawing.append(heat);
  const things = plan.objects.map(([category, ox, oz]) => {
    const thing = category === goal ? star(ox, -oz, 2.2 * unit)
      : shape("circle", { class: "object", cx: ox, cy: -oz, r: 0.55 * unit });
    thing.append(shape("title", {}, categories[category]));
    return [category === goal, thing];
  });
  things.sort((a, b) => a[0] - b[0]).forEach(([, thing]) => drawing.append(thing));
  const labels = placeLabels(plan, categories, goal, unit);
  drawing.append(...labels.map((label) => label.text), ...scaleBar(x, -z + 2.4 * unit, unit));
  return { drawing, unit, labels, heat };
}

// The belief before a step: squares in the opacity of their probability over that of the likeliest square.

const FAINT = 0.03, STRONG = 0.75;

function drawBelief({ steps, corner: [x, z], side, columns }, shares, step) {
  const frame = steps.filter((chosen) => chosen <= step).length - 1;
  const squares = frame < 0 ? 0 : shares.length / steps.length, drawn = [];
  for (let square = 0; square < squares; square++) {
    const share = shares[frame * squares + square];
    if (share < FAINT) continue;
    const place = [x + (square % columns) * side, z + Math.floor(square / columns) * side, side, side];
    const drawing = rectangle(place, "square");
    drawing.setAttribute("fill-opacity", STRONG * share);
    drawn.push(drawing);
  }
  return drawn;
}

// Names of objects, the goal first; a name that would cover another name or a dot is left to the dot's title.

const SHARED = 100; // centimetres within which objects of a category share a name

function placeLabels(plan, categories, goal, unit) {
  const [x, z, width, depth] = plan.box, high = 2.9 * unit, gap = 1.2 * unit, edge = 3 * unit;
  const taken = plan.objects.map(([, ox, oz]) => [ox - 0.6 * unit, -oz - 0.6 * unit, 1.2 * unit, 1.2 * unit]);
  const labels = [], objects = [...plan.objects].sort((a, b) => (b[0] === goal) - (a[0] === goal));
  for (const [category, ox, oz] of objects) {
    if (labels.some((label) => label.category === category && Math.hypot(label.x - ox, label.z - oz) < SHARED)) continue;
    const sought = category === goal, wide = 0.58 * high * categories[category].length;
    const away = sought ? 2.6 * unit : gap;
    const corners = [
      [away, -high / 2], [-away - wide, -high / 2], [-wide / 2, -away - high], [-wide / 2, away],
      [away / 2, -away - high], [away / 2, away], [-wide - away / 2, -away - high], [-wide - away / 2, away],
    ];
    const boxes = corners.map(([dx, dy]) => [ox + dx, -oz + dy, wide, high]);
    const inside = ([bx, by]) => bx > x - edge && bx + wide < x + width + edge && by > -z - depth - edge && by + high < -z + edge;
    const box = boxes.find((place) => inside(place) && !taken.some((other) => overlap(place, other))) ?? (sought ? boxes[0] : null);
    if (!box) continue;
    taken.push(box);
    const text = shape("text", { class: sought ? "label sought" : "label", x: box[0], y: box[1] + 0.8 * high }, categories[category]);
    labels.push({ category, x: ox, z: oz, text });
  }
  return labels;
}

const overlap = ([ax, ay, aw, ah], [bx, by, bw, bh]) => ax < bx + bw && bx < ax + aw && ay < by + bh && by < ay + ah;

function scaleBar(x, y, unit) {
  return [shape("path", { class: "scale", d: `M${x},${y - 0.7 * unit} v${0.7 * unit} h100 v${-0.7 * unit}`, "stroke-width": 0.35 * unit }),
    shape("text", { class: "label", x: x + 100 + unit, y }, "1 m")];
}

function roomName({ name, cells }) {
  const area = cells.reduce((sum, [, , w, d]) => sum + w * d, 0);
  const centre = (at) => cells.reduce((sum, cell) => sum + (cell[at] + cell[at + 2] / 2) * cell[2] * cell[3], 0) / area;
  return shape("text", { class: "name", x: centre(0), y: -centre(1) }, name.replaceAll("_", " "));
}

function star(x, y, size) {
  const points = Array.from({ length: 10 }, (_, i) => {
    const radius = i % 2 ? 0.42 * size : size, angle = (i * Math.PI) / 5;
    return `${x + radius * Math.sin(angle)},${y - radius * Math.cos(angle)}`;
  });
  return shape("polygon", { class: "goal", points: points.join(" "), "stroke-width": 0.15 * size });
}

function drawView(view, optics, categories, unit, goal, labels) {
  const depths = unpack(view.cone), { field_of_view: width, reach } = optics;
  const outline = Array.from(depths, (depth, i) => {
    const angle = ((view.yaw + width * (i / (depths.length - 1) - 0.5)) * Math.PI) / 180;
    return `${view.x + depth * reach * Math.sin(angle)},${-view.z - depth * reach * Math.cos(angle)}`;
  });
  // A detection has a name of its own where no object of the category is named nearby, as at a false alarm.
  const named = (category, x, z) => labels.some((label) => label.category === category && Math.hypot(label.x - x, label.z - z) < SHARED);
  const rings = view.seen.flatMap(([category, x, z]) => [
    shape("circle", {
      class: category === goal ? "ring sought" : "ring", cx: x, cy: -z, r: 1.7 * unit, "stroke-width": 0.45 * unit,
    }),
    ...(named(category, x, z) ? [] : [shape("text", { class: "detection", x: x + 2.3 * unit, y: -z + unit }, categories[category])]),
  ]);
  const arrow = shape("path", {
    class: "agent", d: "M0,-1 L.75,.9 L0,.45 L-.75,.9 Z", "stroke-width": 0.14,
    transform: `translate(${view.x} ${-view.z}) rotate(${view.yaw}) scale(${2.2 * unit})`,
  });
  return [shape("polygon", { class: "cone", points: `${view.x},${-view.z} ${outline.join(" ")}` }), ...rings, arrow];
}

// The course of an episode

function bar(name, shares, kinds, emphasis, whole = 1) {
  const strips = shares.map((share, i) => {
    const strip = element("i", { className: kinds[i] });
    strip.style.width = `${(100 * share) / whole}%`;
    return strip;
  });
  return [element("span", { className: emphasis, title: name }, name), element("span", { className: "bar" }, ...strips),
    element("span", { className: emphasis }, `${Math.round(100 * shares[shares.length - 1])} %`)];
}

function drawCourse(gap, weight, threshold, cursor, length) {
  const steps = (values) => Array.from(values, (value, i) => `${i},${1 - value} ${i + 1},${1 - value}`).join(" ");
  const lines = threshold === null || threshold > 1 ? []
    : [shape("line", { class: "level", x1: 0, x2: length, y1: 1 - threshold, y2: 1 - threshold })];
  cursor.setAttribute("y1", 0);
  cursor.setAttribute("y2", 1);
  return shape("svg", { class: "course", viewBox: `0 0 ${length} 1`, preserveAspectRatio: "none", role: "img",
    "aria-label": "Layout gap, and share of experience that is removed, by step" },
  shape("polygon", { class: "weight", points: `0,1 ${steps(weight)} ${weight.length},1` }),
  ...lines, shape("polyline", { class: "gap", points: steps(gap) }), cursor);
}

function ending({ success, actions }, withWord = true) {
  const count = actions.length, word = success ? "found" : actions[count - 1] === DONE ? "wrong Done" : "out of time";
  const properties = { className: success ? "good" : "bad", title: `${word} after ${count} actions` };
  return element("span", properties, `${success ? "✓" : "✕"} ${withWord ? `${word}, ` : ""}${count}`);
}
