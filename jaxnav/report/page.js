"use strict";
// The replays. Every name goes through textContent, none is parsed.
(() => {
  const ACTIONS = ["move ahead", "turn left", "turn right", "look up", "look down", "Done"];
  const DONE = 5, DELAY = 220, MOST = 6; // milliseconds a step; bars in a list
  const KINDS = ["factual", "counterfactual", "corrected"];
  const shifts = JSON.parse(document.getElementById("data").textContent);
  const state = { shift: 0, episode: 0, step: 0, players: [0, 0], timer: null };
  const part = (id) => document.getElementById(id);

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

  const unpack = (text) => Float64Array.from(atob(text), (byte) => byte.charCodeAt(0) / 255);
  const shown = () => shifts[state.shift];
  const current = () => shown().episodes[state.episode];
  const courses = () => state.players.map((player) => current().courses[player]);
  const lasting = () => Math.max(...courses().map((course) => course.actions.length));
  const rectangle = ([x, z, width, height], kind) => shape("rect", { x, y: -z - height, width, height, class: kind });

  // The plan: y is -z, so that z points up; lengths are centimetres.

  function drawPlan(plan, goal) {
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
    const things = plan.objects.map(([category, ox, oz]) => {
      const thing = category === goal ? star(ox, -oz, 2.2 * unit)
        : shape("circle", { class: "object", cx: ox, cy: -oz, r: 0.55 * unit });
      thing.append(shape("title", {}, shown().categories[category]));
      return [category === goal, thing];
    });
    things.sort((a, b) => a[0] - b[0]).forEach(([, thing]) => drawing.append(thing));
    return { drawing, unit };
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

  function drawView(view, unit, goal) {
    const depths = unpack(view.cone), { field_of_view: width, reach } = shown();
    const outline = Array.from(depths, (depth, i) => {
      const angle = ((view.yaw + width * (i / (depths.length - 1) - 0.5)) * Math.PI) / 180;
      return `${view.x + depth * reach * Math.sin(angle)},${-view.z - depth * reach * Math.cos(angle)}`;
    });
    const rings = view.seen.flatMap(([category, x, z]) => [
      shape("circle", {
        class: category === goal ? "ring sought" : "ring", cx: x, cy: -z, r: 1.7 * unit, "stroke-width": 0.45 * unit,
      }),
      shape("text", { x: x + 2.3 * unit, y: -z + unit }, shown().categories[category]),
    ]);
    const arrow = shape("path", {
      class: "agent", d: "M0,-1 L.75,.9 L0,.45 L-.75,.9 Z", "stroke-width": 0.14,
      transform: `translate(${view.x} ${-view.z}) rotate(${view.yaw}) scale(${2.2 * unit})`,
    });
    return [shape("polygon", { class: "cone", points: `${view.x},${-view.z} ${outline.join(" ")}` }), ...rings, arrow];
  }

  // One side: an agent in the present episode.

  function makeSide(number) {
    const { players, thresholds, plans, categories } = shown(), episode = current(), plan = plans[episode.plan];
    const player = state.players[number], course = episode.courses[player];
    const [gap, weight, layout, chances] = [course.gap, course.weight, course.layout, course.chances].map(unpack);
    const { drawing, unit } = drawPlan(plan, episode.goal);
    const moving = shape("g"), doing = element("span"), level = element("span"), cursor = shape("line", { class: "cursor" });
    const [actions, seen, layouts] = [0, 1, 2].map(() => element("div", { className: "bars" }));
    const choice = element("select", { ariaLabel: number ? "Right agent" : "Left agent" },
      ...players.map((name, i) => element("option", { value: i, selected: i === player }, name)));
    choice.addEventListener("change", () => { state.players[number] = Number(choice.value); show(); });
    drawing.append(moving);
    const key = element("span", { className: "key" },
      ...KINDS.map((kind, i) => element("b", { style: `color: var(--${["blue", "pale", "orange"][i]})` }, kind)));
    const root = element("article", { className: "side" }, choice,
      element("p", { className: "status" }, doing, ending(course)), drawing,
      element("h3", {}, "Layout gap", level), drawCourse(gap, weight, thresholds[player], cursor),
      element("h3", {}, "Action", key), actions,
      element("div", { className: "pair" },
        element("div", {}, element("h3", {}, "Detected now"), seen),
        element("div", {}, element("h3", {}, "Goal expected beside"), layouts)));

    function update(step) {
      const at = Math.min(step, course.actions.length - 1), view = plan.views[course.views[at]];
      const path = course.views.slice(0, at + 1).map((i) => plan.views[i]).map((v) => `${v.x},${-v.z}`);
      const [sx, sy] = path[0].split(",");
      moving.replaceChildren(
        shape("polyline", { class: "path", points: path.join(" "), "stroke-width": 0.7 * unit }),
        shape("circle", { class: "start", cx: sx, cy: sy, r: unit, "stroke-width": 0.4 * unit }),
        ...drawView(view, unit, episode.goal));
      const action = course.actions[at], ended = step >= course.actions.length;
      doing.textContent = ended ? `ended at step ${at + 1}` : `step ${at + 1}: ${ACTIONS[action]}`;
      level.textContent = `D ${gap[at].toFixed(2)}, removed with weight ${weight[at].toFixed(2)}`;
      for (const end of ["x1", "x2"]) cursor.setAttribute(end, at + 0.5);
      actions.replaceChildren(...ACTIONS.flatMap((name, i) => {
        const three = KINDS.map((_, kind) => chances[(at * 3 + kind) * ACTIONS.length + i]);
        return bar(name, three, KINDS, i === action ? "chosen" : "");
      }));
      list(seen, view.seen.map(([category, , , sure]) => [sure / 100, category]), 1);
      const known = Array.from(layout.slice(at * categories.length, (at + 1) * categories.length), (w, i) => [w, i]);
      const others = known.filter(([w, i]) => w > 0 && i !== episode.goal).sort((a, b) => b[0] - a[0]);
      list(layouts, others, others.length ? others[0][0] : 1);
    }
    function list(where, shares, whole) {
      const bars = shares.slice(0, MOST).flatMap(([share, category]) =>
        bar(categories[category], [share], [category === episode.goal ? "sought" : "other"], "", whole));
      where.replaceChildren(...(bars.length ? bars : [element("span", { className: "none" }, "nothing")]));
    }

    return { root, update };
  }

  function bar(name, shares, kinds, emphasis, whole = 1) {
    const strips = shares.map((share, i) => {
      const strip = element("i", { className: kinds[i] });
      strip.style.width = `${(100 * share) / whole}%`;
      return strip;
    });
    return [element("span", { className: emphasis, title: name }, name), element("span", { className: "bar" }, ...strips),
      element("span", { className: emphasis }, `${Math.round(100 * shares[shares.length - 1])} %`)];
  }

  function drawCourse(gap, weight, threshold, cursor) {
    const steps = (values) => Array.from(values, (value, i) => `${i},${1 - value} ${i + 1},${1 - value}`).join(" ");
    const lines = threshold === null || threshold > 1 ? []
      : [shape("line", { class: "level", x1: 0, x2: lasting(), y1: 1 - threshold, y2: 1 - threshold })];
    cursor.setAttribute("y1", 0);
    cursor.setAttribute("y2", 1);
    return shape("svg", { class: "course", viewBox: `0 0 ${lasting()} 1`, preserveAspectRatio: "none", role: "img",
      "aria-label": "Layout gap, and weight of what is removed, by step" },
    shape("polygon", { class: "weight", points: `0,1 ${steps(weight)} ${weight.length},1` }),
    ...lines, shape("polyline", { class: "gap", points: steps(gap) }), cursor);
  }

  function ending({ success, actions }, told = true) {
    const count = actions.length, word = success ? "found" : actions[count - 1] === DONE ? "wrong Done" : "out of time";
    const properties = { className: success ? "good" : "bad", title: `${word} after ${count} actions` };
    return element("span", properties, `${success ? "✓" : "✕"} ${told ? `${word}, ` : ""}${count}`);
  }

  // The list of episodes, in the order of the two agents that are compared.

  const differs = ([a, b]) => a.success !== b.success || a.actions.length !== b.actions.length;
  const pair = (episode) => [episode.courses[state.players[0]], episode.courses[state.players[1]]];

  function order() {
    const all = shown().episodes.map((episode, index) => ({ index, same: !differs(pair(episode)) }));
    return all.sort((a, b) => a.same - b.same || a.index - b.index).map(({ index }) => index);
  }

  function listEpisodes() {
    const { episodes, plans, categories, differ, evaluated, players, split } = shown();
    const [left, right] = state.players, whole = evaluated.toLocaleString("en");
    part("count").textContent = left === right ? `${episodes.length} of ${whole} episodes, ${split}.`
      : `“${players[left]}” and “${players[right]}” end differently, or at another step, in ${differ[left][right]} of `
        + `${whole} episodes (${split}). ${episodes.length} can be replayed, those that differ first.`;
    part("episodes").replaceChildren(...order().map((index) => {
      const episode = episodes[index], button = element("button", { type: "button" },
        element("strong", {}, categories[episode.goal]), element("small", {}, plans[episode.plan].name),
        element("span", { className: "ends" }, ...pair(episode).slice(0, left === right ? 1 : 2).map((course) => ending(course, false))));
      button.setAttribute("aria-current", index === state.episode);
      button.addEventListener("click", () => choose(index));
      return element("li", {}, button);
    }));
  }

  let sides = [];

  function show() {
    const number = shown().players.length > 1 ? 2 : 1, list = part("episodes"), { scrollTop } = list;
    sides = Array.from({ length: number }, (_, i) => makeSide(i));
    part("sides").replaceChildren(...sides.map(({ root }) => root));
    listEpisodes();
    list.scrollTop = scrollTop;
    part("step").max = lasting() - 1;
    move(Math.min(state.step, lasting() - 1));
  }

  function move(step) {
    state.step = step;
    part("step").value = step;
    part("now").textContent = `step ${step + 1} of ${lasting()}`;
    sides.forEach(({ update }) => update(step));
  }

  function choose(index) {
    pause();
    Object.assign(state, { episode: index, step: 0 });
    show();
    const { offsetTop, offsetHeight } = document.querySelector('#episodes [aria-current="true"]'), list = part("episodes");
    if (offsetTop < list.scrollTop) list.scrollTop = offsetTop;
    if (offsetTop + offsetHeight > list.scrollTop + list.clientHeight) list.scrollTop = offsetTop + offsetHeight - list.clientHeight;
  }

  function chooseShift(index) {
    const { players, thresholds } = shifts[index], removing = thresholds.findIndex((threshold) => threshold !== null);
    // Without and with removal, where there is one.
    const compared = removing > 0 ? [removing - 1, removing] : [0, players.length - 1];
    Object.assign(state, { shift: index, players: compared });
    if (shifts.length > 1) part("shifts").replaceChildren(...shifts.map(({ shift }, i) => {
      const button = element("button", { type: "button", ariaPressed: String(i === index) }, `Shift ${shift}`);
      button.addEventListener("click", () => chooseShift(i));
      return button;
    }));
    choose(order()[0]);
  }

  // Slider, button and keys

  function pause() {
    clearInterval(state.timer);
    state.timer = null;
    part("play").textContent = "Play";
  }

  function play() {
    if (state.timer !== null) return pause();
    if (state.step >= lasting() - 1) move(0);
    part("play").textContent = "Pause";
    state.timer = setInterval(() => (state.step < lasting() - 1 ? move(state.step + 1) : pause()), DELAY);
  }

  function nextEpisode(by) {
    const all = order(), place = all.indexOf(state.episode) + by;
    if (place >= 0 && place < all.length) choose(all[place]);
  }

  const keys = {
    ArrowLeft: () => move(Math.max(state.step - 1, 0)),
    ArrowRight: () => move(Math.min(state.step + 1, lasting() - 1)),
    " ": play,
    n: () => nextEpisode(1),
    p: () => nextEpisode(-1),
  };

  part("replays").addEventListener("keydown", (event) => {
    const { key, target } = event, native = target.tagName;
    const taken = native === "SELECT" || (native === "BUTTON" && key === " ") || (native === "INPUT" && key.startsWith("Arrow"));
    if (taken || event.ctrlKey || event.metaKey || event.altKey || !Object.hasOwn(keys, key)) return;
    event.preventDefault();
    keys[key]();
  });
  part("step").addEventListener("input", (event) => { pause(); move(Number(event.target.value)); });
  part("play").addEventListener("click", play);
  part("player").hidden = false;
  chooseShift(0);
})();
