// The replays: two agents in the same episode, and the controls that move them.

const DELAY = 220, MOST = 6; // milliseconds a step; bars in a list
const shifts = JSON.parse(document.getElementById("data").textContent);
const state = { shift: 0, episode: 0, step: 0, players: [0, 0], timer: null };
const part = (id) => document.getElementById(id);
const shown = () => shifts[state.shift];
const current = () => shown().episodes[state.episode];
const lasting = () => Math.max(...state.players.map((player) => current().courses[player].actions.length));

const layoutName = (shift) => (shift ? `layout shift ${shift}` : "layout as trained");

// One side: an agent in the present episode.

function makeSide(number) {
  const { players, layouts, thresholds, plans, categories } = shown(), episode = current();
  const player = state.players[number], course = episode.courses[player], plan = plans[course.plan];
  const [gap, weight, layout, chances] = [course.gap, course.weight, course.layout, course.chances].map(unpack);
  const { drawing, unit, labels, heat } = drawPlan(plan, categories, episode.goal);
  const belief = course.belief && unpack(course.belief.shares);
  const moving = shape("g"), doing = element("span"), level = element("span"), cursor = shape("line", { class: "cursor" });
  const [actions, seen, expected] = [0, 1, 2].map(() => element("div", { className: "bars" }));
  const choice = element("select", { ariaLabel: number ? "Right agent" : "Left agent" },
    ...players.map((name, i) => element("option", { value: i, selected: i === player }, name)));
  choice.addEventListener("change", () => { state.players[number] = Number(choice.value); show(); });
  drawing.append(moving);
  const key = element("span", { className: "key" },
    ...KINDS.map((kind, i) => element("b", { style: `color: var(--${["blue", "pale", "orange"][i]})` }, term(kind, ["factual", "factual", "stde"][i]))));
  const root = element("article", { className: "side" }, choice,
    element("p", { className: "status" }, doing, element("span", {}, layoutName(layouts[player])), ending(course)), drawing,
    element("h3", {}, term("Layout gap", "gap"), level), drawCourse(gap, weight, thresholds[player], cursor, lasting()),
    element("h3", {}, "Action", key), actions,
    element("div", { className: "pair" },
      element("div", {}, element("h3", {}, "Detected now"), seen),
      element("div", {}, element("h3", {}, term("Goal expected near", "weights")), expected)));

  function update(step) {
    const at = Math.min(step, course.actions.length - 1), view = plan.views[course.views[at]];
    const path = course.views.slice(0, at + 1).map((i) => plan.views[i]).map((v) => `${v.x},${-v.z}`);
    const [sx, sy] = path[0].split(",");
    moving.replaceChildren(
      shape("polyline", { class: "path", points: path.join(" "), "stroke-width": 0.7 * unit }),
      shape("circle", { class: "start", cx: sx, cy: sy, r: unit, "stroke-width": 0.4 * unit }),
      shape("text", { class: "label", x: Number(sx) + 1.6 * unit, y: Number(sy) + 3.2 * unit }, at ? "start" : ""),
      ...drawView(view, shown(), categories, unit, episode.goal, labels));
    if (belief) heat.replaceChildren(...drawBelief(course.belief, belief, at));
    const action = course.actions[at], ended = step >= course.actions.length;
    doing.textContent = ended ? `ended at step ${at + 1}` : `step ${at + 1}: ${ACTIONS[action]}`;
    level.textContent = `D ${gap[at].toFixed(2)}, removed share ${weight[at].toFixed(2)}`;
    for (const end of ["x1", "x2"]) cursor.setAttribute(end, at + 0.5);
    if (!chances.length) actions.replaceChildren(element("span", { className: "none" }, "This policy chooses places, not actions."));
    else actions.replaceChildren(...ACTIONS.flatMap((name, i) => {
      const three = KINDS.map((_, kind) => chances[(at * 3 + kind) * ACTIONS.length + i]);
      return bar(name, three, KINDS, i === action ? "chosen" : "");
    }));
    list(seen, view.seen.map(([category, , , sure]) => [sure / 100, category]), 1, "no detections");
    const weights = Array.from(layout.slice(at * categories.length, (at + 1) * categories.length), (w, i) => [w, i]);
    const otherWeights = weights.filter(([w, i]) => w > 0 && i !== episode.goal).sort((a, b) => b[0] - a[0]);
    list(expected, otherWeights, otherWeights.length ? otherWeights[0][0] : 1, "no layout weights");
  }
  function list(where, shares, whole, none) {
    const bars = shares.slice(0, MOST).flatMap(([share, category]) =>
      bar(categories[category], [share], [category === episode.goal ? "sought" : "other"], "", whole));
    where.replaceChildren(...(bars.length ? bars : [element("span", { className: "none" }, none)]));
  }

  return { root, update };
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
  const count = differ[left][right];
  part("count").textContent = left !== right && count === null
    ? `“${players[left]}” and “${players[right]}” act in different layouts of the same homes, with equal goals and starts. `
      + `${episodes.length} episodes can be replayed; those with a difference come first.`
    : left === right ? `${episodes.length} of ${whole} ${split} episodes can be replayed.`
    : `“${players[left]}” and “${players[right]}” differ in success or in the number of actions in ${count} `
      + `of ${whole} episodes (${split}). ${episodes.length} episodes can be replayed; those with a difference come first.`;
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
  part("heat").hidden = !current().courses.some((course) => course.belief);
  const number = shown().players.length > 1 ? 2 : 1, list = part("episodes"), { scrollTop } = list;
  drawTabs();
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

function tab(name, pressed, choose) {
  const button = element("button", { type: "button" }, name);
  button.setAttribute("aria-pressed", pressed);
  button.addEventListener("click", choose);
  return button;
}

function drawTabs() {
  const compared = Object.entries(shown().comparisons), chosen = String(state.players);
  part("comparisons").replaceChildren(...compared.map(([name, players]) =>
    tab(name, chosen === String(players), () => compare(players))));
  if (shifts.length > 1) part("shifts").replaceChildren(...shifts.map(({ shift }, i) =>
    tab(`Shift ${shift}`, i === state.shift, () => chooseShift(i))));
}

function compare(players) {
  state.players = [...players];
  choose(order()[0]);
}

function chooseShift(index) {
  state.shift = index;
  compare(state.players);
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
compare(Object.values(shown().comparisons)[0] ?? [0, shown().players.length - 1]);
