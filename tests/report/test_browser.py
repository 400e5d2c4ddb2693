"""The page in a browser: the slider moves both agents in step, and hostile names do not run."""

import html
import json
import re
import shutil
import subprocess

import pytest
from support.report_page import example_page, example_replays

BROWSER = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome", "chrome"))), None)
pytestmark = [pytest.mark.slow, pytest.mark.skipif(BROWSER is None, reason="no Chromium")]

#: Code that would run if a name became a tag or an attribute.
PAYLOAD = "document.documentElement.dataset.ran = 1"
HOSTILE = f"</script><script>{PAYLOAD}</script><img src=x onerror='{PAYLOAD}'>"

#: Moves the slider, presses keys and buttons, and writes down what the page shows.
DRIVE_SCRIPT = """
<script>
const seen = [], by = (query) => [...document.querySelectorAll(query)];
const read = () => seen.push({
  step: document.getElementById("step").value,
  now: document.getElementById("now").textContent,
  agents: by(".plan .agent").map((agent) => agent.getAttribute("transform")),
  labels: by(".side:first-child .plan .label").map((label) => label.textContent).filter(Boolean),
  heat: by(".heat .square").map((square) => [Number(square.getAttribute("x")), Number(square.getAttribute("y"))]),
  cursors: by(".cursor").map((cursor) => Number(cursor.getAttribute("x1"))),
});
const section = document.getElementById("replays"), slider = document.getElementById("step");
const press = (key) => section.dispatchEvent(new KeyboardEvent("keydown", { key, bubbles: true }));
for (let step = 0; step <= Number(slider.max); step++) {
  slider.value = step;
  slider.dispatchEvent(new Event("input"));
  read();
}
for (const key of ["ArrowLeft", "ArrowLeft", "ArrowRight", "x"]) { press(key); read(); }
const goals = by("#episodes strong").map((goal) => goal.textContent);
const agents = () => by("select").map((choice) => choice.selectedIndex);
const before = agents();
by("#comparisons button")[1].click();
const swapped = agents();
by("#comparisons button")[0].click();
press("n");
const after = document.querySelector('#episodes [aria-current="true"] strong').textContent;
press("p");
press(" ");
const playing = document.getElementById("play").textContent;
setTimeout(() => {
  read();
  const verdict = document.createElement("pre");
  verdict.id = "verdict";
  verdict.textContent = JSON.stringify({
    seen, goals, after, playing, before, swapped, stopped: document.getElementById("play").textContent,
    count: document.getElementById("count").textContent, options: by("option").map((option) => option.textContent),
  });
  document.body.append(verdict);
}, 3000);
</script>
"""


def open_in_browser(folder, page_text):
    """The document after a while, and the lines on the browser's console."""
    file = folder / "page.html"
    file.write_text(page_text, encoding="utf-8")
    command = [str(BROWSER), "--headless", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage"]
    command += ["--enable-logging=stderr", f"--user-data-dir={folder / 'profile'}"]
    command += ["--virtual-time-budget=8000", "--dump-dom", file.as_uri()]
    process = subprocess.run(command, capture_output=True, text=True, timeout=120)
    console_lines = [line for line in process.stderr.splitlines() if "CONSOLE" in line]
    return process.stdout, console_lines


def without_policy(page_text):
    """The page without its content security policy."""
    return re.sub(r'<meta http-equiv="Content-Security-Policy"[^>]*>', "", page_text)


def payload_ran(document):
    return "data-ran" in document.partition("<head>")[0]


@pytest.fixture(scope="module")
def verdict(tmp_path_factory):
    """The page as a reader sees it who uses slider, keys and buttons."""
    page_text = without_policy(example_page()).replace("</body>", DRIVE_SCRIPT + "</body>")
    document, console_lines = open_in_browser(tmp_path_factory.mktemp("browser"), page_text)
    assert console_lines == []
    verdict_text = document.partition('<pre id="verdict">')[2].partition("</pre>")[0]
    return json.loads(html.unescape(verdict_text))


def test_slider_moves_both_agents_in_step(verdict):
    replays = example_replays()
    (plan,) = replays.plans
    slider_states = verdict["seen"][:5]
    assert [state["now"] for state in slider_states] == [f"step {step + 1} of 5" for step in range(5)]

    # The second episode, in which the agents differ: the shorter walk waits at its end.
    for step, state in enumerate(slider_states):
        expected_places = []
        for trace in replays.episodes[1].courses:
            view = plan.views[trace.views[min(step, len(trace.views) - 1)]]
            expected_places.append((view.x, -view.z))
        agent_places = [tuple(map(int, re.findall(r"-?\d+", transform)[:2])) for transform in state["agents"]]
        assert agent_places == expected_places
        assert state["cursors"] == [min(step, 2) + 0.5, step + 0.5]
    assert len({tuple(state["agents"]) for state in slider_states}) > 3


def test_plan_names_the_goal_and_objects_and_shows_start_and_scale(verdict):
    replays = example_replays()
    goal = replays.categories[replays.episodes[1].goal]
    categories_in_plan = {replays.categories[category] for category, *_ in replays.plans[0].objects}
    labels = verdict["seen"][2]["labels"]
    assert labels[0] == goal
    assert {"1 m", "start"} <= set(labels)
    assert set(labels) - {"1 m", "start"} <= categories_in_plan


def test_heat_map_shows_the_latest_belief(verdict):
    """Squares of 50 cm from (-12, -12), row by row along z; y is -z at the far side of a square."""
    first_belief = [[-12, -38], [38, -38]]
    second_belief = [[88, -38], [-12, -88], [38, -88], [88, -88]]
    heat_maps = [state["heat"] for state in verdict["seen"][:5]]
    assert heat_maps == [[], first_belief, first_belief, second_belief, second_belief]


def test_keys_step_and_change_the_episode(verdict):
    assert [state["step"] for state in verdict["seen"][5:9]] == ["3", "2", "3", "3"]
    replays = example_replays()
    goals = [replays.categories[episode.goal] for episode in reversed(replays.episodes)]
    assert verdict["goals"] == goals  # episodes in which the agents differ come first
    assert verdict["after"] == goals[1]


def test_comparison_button_selects_both_agents(verdict):
    assert (verdict["before"], verdict["swapped"]) == ([0, 1], [1, 0])


def test_play_button_plays_to_the_end(verdict):
    assert (verdict["playing"], verdict["stopped"]) == ("Pause", "Play")
    assert verdict["seen"][-1]["step"] == "4"


def test_page_counts_the_episodes_that_differ(verdict):
    assert "in 7 of 24 episodes" in verdict["count"]
    assert verdict["options"] == 2 * example_replays().players


@pytest.mark.parametrize("suffix", ["", HOSTILE])
def test_page_logs_nothing_and_runs_no_name(tmp_path, suffix):
    document, console_lines = open_in_browser(tmp_path, example_page(suffix))
    assert console_lines == []
    assert not payload_ran(document)
    assert document.count('class="side"') == 2  # the replays are shown


def test_page_runs_no_name_without_its_policy(tmp_path):
    document, _ = open_in_browser(tmp_path, without_policy(example_page(HOSTILE)))
    assert not payload_ran(document)


def test_policy_stops_a_script_that_would_run_without_it(tmp_path):
    """Control: the payload works, and the policy stops it."""
    page_text = example_page().replace("</body>", f"<script>{PAYLOAD}</script></body>")
    open_document, _ = open_in_browser(tmp_path, without_policy(page_text))
    guarded_document, console_lines = open_in_browser(tmp_path, page_text)
    assert payload_ran(open_document)
    assert not payload_ran(guarded_document)
    assert "Content Security Policy" in console_lines[0]
