"""The page in a browser: the slider moves both agents in step, and hostile names do not run."""

import html
import json
import re
import shutil
import subprocess

import pytest
from support.report_page import page, replays

BROWSER = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome", "chrome"))), None)
pytestmark = [pytest.mark.slow, pytest.mark.skipif(BROWSER is None, reason="no Chromium")]

#: What would run if it were taken for a tag or an attribute.
PAYLOAD = "document.documentElement.dataset.ran = 1"
HOSTILE = f"</script><script>{PAYLOAD}</script><img src=x onerror='{PAYLOAD}'>"

DRIVE = """
<script>
const seen = [], by = (query) => [...document.querySelectorAll(query)];
const read = () => seen.push({
  step: document.getElementById("step").value,
  now: document.getElementById("now").textContent,
  agents: by(".agent").map((agent) => agent.getAttribute("transform")),
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


def browse(folder, text):
    """The document as it is after a while, and what was said on the console."""
    file = folder / "page.html"
    file.write_text(text, encoding="utf-8")
    options = ["--headless", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage", "--enable-logging=stderr"]
    options += [f"--user-data-dir={folder / 'profile'}", "--virtual-time-budget=8000", "--dump-dom", file.as_uri()]
    done = subprocess.run([str(BROWSER), *options], capture_output=True, text=True, timeout=120)
    return done.stdout, [line for line in done.stderr.splitlines() if "CONSOLE" in line]


def open_to_scripts(text):
    """The page without its policy."""
    return re.sub(r'<meta http-equiv="Content-Security-Policy"[^>]*>', "", text)


@pytest.fixture(scope="module")
def driven(tmp_path_factory):
    """What a reader who uses slider, keys and button sees."""
    text = open_to_scripts(page()).replace("</body>", DRIVE + "</body>")
    document, console = browse(tmp_path_factory.mktemp("browser"), text)
    assert console == []
    return json.loads(html.unescape(document.partition('<pre id="verdict">')[2].partition("</pre>")[0]))


def test_the_slider_moves_both_agents_in_step(driven):
    (plan,), episode = replays().plans, replays().episodes[1]  # that in which the agents differ
    assert [state["now"] for state in driven["seen"][:5]] == [f"step {step + 1} of 5" for step in range(5)]
    for step, state in enumerate(driven["seen"][:5]):
        places = [plan.views[c.views[min(step, len(c.views) - 1)]] for c in episode.courses]
        poses = [tuple(map(int, re.findall(r"-?\d+", agent)[:2])) for agent in state["agents"]]
        assert poses == [(view.x, -view.z) for view in places]
        assert state["cursors"] == [min(step, 2) + 0.5, step + 0.5]
    assert len({tuple(state["agents"]) for state in driven["seen"][:5]}) > 3


def test_keys_step_and_change_the_episode(driven):
    assert [state["step"] for state in driven["seen"][5:9]] == ["3", "2", "3", "3"]
    goals = [replays().categories[episode.goal] for episode in reversed(replays().episodes)]
    assert driven["goals"] == goals  # those that differ come first
    assert driven["after"] == goals[1]


def test_a_comparison_chooses_both_agents(driven):
    assert (driven["before"], driven["swapped"]) == ([0, 1], [1, 0])


def test_the_button_plays_to_the_end(driven):
    assert (driven["playing"], driven["stopped"]) == ("Pause", "Play")
    assert driven["seen"][-1]["step"] == "4"


def test_the_count_of_differing_episodes_is_told(driven):
    assert "in 7 of 24 episodes" in driven["count"]
    assert driven["options"] == 2 * replays().players


@pytest.mark.parametrize("name", ["", HOSTILE])
def test_the_console_is_silent_and_nothing_runs(tmp_path, name):
    document, console = browse(tmp_path, page(name))
    assert console == []
    assert "data-ran" not in document.partition("<head>")[0]
    assert document.count('class="side"') == 2  # the replays are there


def test_nothing_runs_even_without_the_policy(tmp_path):
    document, _ = browse(tmp_path, open_to_scripts(page(HOSTILE)))
    assert "data-ran" not in document.partition("<head>")[0]


def test_what_is_no_text_runs_unless_the_policy_forbids_it(tmp_path):
    """A control: the payload works, and the policy stops it."""
    text = page().replace("</body>", f"<script>{PAYLOAD}</script></body>")
    ran, stopped = (browse(tmp_path, page_text) for page_text in (open_to_scripts(text), text))
    assert "data-ran" in ran[0].partition("<head>")[0]
    assert "data-ran" not in stopped[0].partition("<head>")[0]
    assert "Content Security Policy" in stopped[1][0]  # the console is heard
