"""The glossary of the report: terms with their definitions, and their marks in the texts of the page.

`mark_terms` makes a term a button that opens its definition where it stands. The page needs no script for this.
"""

import re
from typing import NamedTuple


class Term(NamedTuple):
    """Term of the glossary.

    Attributes:
      key: short name in the page, which is unique.
      name: name in the list of terms.
      definition: one or two sentences.
      spellings: words in texts and tables that open the definition; empty for terms that have none of their own.
    """

    key: str
    name: str
    definition: str
    spellings: tuple[str, ...] = ()


GLOSSARY = (
    Term(
        "experience",
        "Experience, Z",
        "Learned knowledge of which things tend to stand near each other, in the training scenes. Z is the part of the "
        "network that holds this knowledge.",
        ("Experience", "experience", "Z"),
    ),
    Term(
        "shift",
        "Layout shift",
        "A number from 0 to 1: the share of the categories in a scene that have exchanged places. Shift 0 is the "
        "training layout.",
        ("Layout shift", "layout shift", "Shift", "shift"),
    ),
    Term(
        "weights",
        "Layout weights, w",
        "One weight for each category: how much the goal is expected near an object of the category (equations 6 and "
        "7). Rows with “+ w” use these weights in their experience; the baseline does not.",
        ("layout weights", "+ w", "w"),
    ),
    Term(
        "gap",
        "Layout gap, D",
        "A number from 0 to 1 that measures how far the current episode differs from the expected layout (equation 5).",
        ("Layout gap", "layout gap", "D"),
    ),
    Term(
        "prior",
        "Prior, belief",
        "The prior holds how often two categories were seen together in the training scenes. The belief starts at the "
        "prior, and detections in the episode update it.",
        ("prior", "belief"),
    ),
    Term(
        "similarity",
        "Layout similarity",
        "The cosine similarity between the co-occurrences of a goal in a scene and in the prior from training.",
        ("Layout similarity", "layout similarity"),
    ),
    Term(
        "factual",
        "Factual, counterfactual",
        "The preferences of the policy for the actions with all of its inputs, and with scene and goal set to zero.",
        ("factual", "counterfactual"),
    ),
    Term(
        "tde",
        "TDE",
        "Total direct effect (equation 1): the factual minus the counterfactual preferences, in other words experience "
        "removed from every decision.",
        ("TDE",),
    ),
    Term(
        "stde",
        "sTDE, ε (eps)",
        "Soft total direct effect (equation 2): experience is removed where the layout gap exceeds the threshold ε. "
        "For ε ≥ 1 no experience is removed. The result is called corrected.",
        ("sTDE", "ε", "eps", "corrected"),
    ),
    Term(
        "cde",
        "CDE, sCDE",
        "Controlled direct effect: the decision of the same network with its experience set to zero, in every decision "
        "(CDE) or where the layout gap exceeds the threshold (sCDE).",
        ("CDE", "sCDE"),
    ),
    Term(
        "removal",
        "Removal",
        "A comparison of the agent that keeps its experience with the agent from which sTDE removes experience.",
        ("Removal", "removal"),
    ),
    Term(
        "blind",
        "Layout-blind agent",
        "An agent of the method “anonymous”, which cannot know any layout. The comparison “Experience” shows such an "
        "agent on the right.",
        ("layout-blind agents", "layout-blind agent"),
    ),
    Term(
        "lead",
        "Value and cost of experience",
        "The lead of an agent over layout-blind agents on the same episodes. A positive lead is a value of experience; "
        "a negative lead is a cost. “left” is the share of the lead that remains after a removal.",
        ("lead", "left of SR"),
    ),
    Term(
        "decoding",
        "Best, sampled actions",
        "The agent takes the most probable action (“argmax”), or draws an action by its probability (“sample”).",
        ("Best actions", "best actions", "Sampled actions", "sampled actions", "decoding"),
    ),
    Term(
        "sr",
        "SR",
        "Success rate: the share of episodes in which the agent chooses Done where the goal counts as found. “SR "
        "within N” counts success in at most N actions.",
        ("SR", "SR within"),
    ),
    Term(
        "spl",
        "SPL",
        "Success weighted by path length: each success counts by the ratio of the shortest to the taken path, so that "
        "detours cost.",
        ("SPL",),
    ),
    Term("dts", "DTS", "Distance to success at the end of an episode, in metres; 0 where the goal is found.", ("DTS",)),
    Term(
        "failure",
        "Time-out, wrong Done",
        "The two ways to fail: the step limit is reached, or the agent chooses Done where the goal does not count as "
        "found.",
        ("Time-out", "Wrong Done"),
    ),
    Term(
        "share",
        "Decision share",
        "The share of decisions whose best action changes if one part of the decision is replaced by that of another "
        "episode. The partner difference is the share that differs between two other episodes.",
        ("partner difference", "share (%)"),
    ),
    Term(
        "oracle",
        "Shortest path (oracle)",
        "An agent that knows the scene and walks a shortest path; an upper bound for every row.",
        ("oracle",),
    ),
    Term(
        "interval",
        "[a, b] and [-]",
        "A 95 % confidence interval over training runs and scenes; [-] marks that there are too few training runs or "
        "scenes for an interval.",
        ("95 % intervals", "95 % interval"),
    ),
)


def _compile_spellings() -> tuple[re.Pattern[str], dict[str, str]]:
    """Return the pattern of all spellings, and the key of the term of each."""
    key_of_spelling = {}
    for term in GLOSSARY:
        for spelling in term.spellings:
            key_of_spelling[spelling] = term.key

    # The longest spelling comes first, so that "sTDE" and "layout gap" are not cut.
    longest_first = sorted(key_of_spelling, key=len, reverse=True)
    alternatives = "|".join(map(re.escape, longest_first))
    return re.compile(rf"(?<![\w-])({alternatives})(?![\w-])([.,;:)]*)"), key_of_spelling


_SPELLING_PATTERN, _KEY_OF_SPELLING = _compile_spellings()


def mark_terms(html_text: str, marked_keys: set[str]) -> str:
    """Make every term in a text a button that opens its definition.

    Args:
      html_text: escaped text without tags.
      marked_keys: keys of terms that are already marked in this part of the page, and stay text; receives new keys.
    """

    def mark(match: re.Match[str]) -> str:
        spelling, punctuation = match.groups()
        key = _KEY_OF_SPELLING[spelling]
        if key in marked_keys:
            return match[0]
        marked_keys.add(key)

        # No line breaks between a button and the punctuation after it.
        button = f'<button type="button" class="term" popovertarget="about-{key}">{spelling}</button>'
        return f'<span class="whole">{button}{punctuation}</span>' if punctuation else button

    return _SPELLING_PATTERN.sub(mark, html_text)
