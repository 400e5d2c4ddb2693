"""Tests of the terms of the glossary: each word opens its definition, and the rest of the text stays unchanged."""

import re

import pytest

from jaxnav.report.terms import GLOSSARY, mark_terms


def opened_terms(marked_text):
    """Key and word of each button in a text."""
    return re.findall(r'popovertarget="about-(\w+)">([^<]*)</button>', marked_text)


@pytest.mark.parametrize("term", GLOSSARY, ids=lambda term: term.key)
def test_every_spelling_opens_its_definition(term):
    for spelling in term.spellings:
        assert opened_terms(mark_terms(f"a {spelling}, b", set())) == [(term.key, spelling)]


def test_keys_and_spellings_are_unique():
    keys = [term.key for term in GLOSSARY]
    spellings = [spelling for term in GLOSSARY for spelling in term.spellings]
    assert len(set(keys)) == len(keys)
    assert len(set(spellings)) == len(spellings)


def test_a_term_is_marked_only_once_in_a_part_of_the_page():
    marked_keys = set()
    first_text = mark_terms("SR and sTDE", marked_keys)
    assert opened_terms(first_text) == [("sr", "SR"), ("stde", "sTDE")]
    assert opened_terms(mark_terms("SR, ε and TDE", marked_keys)) == [("tde", "TDE")]


@pytest.mark.parametrize("text", ["SRX", "layouts", "non-SR", "&lt;b&gt;", "width", ""])
def test_other_words_stay_as_they_are(text):
    assert mark_terms(text, set()) == text


def test_marks_keep_the_text():
    text = "The lead (in SR, SPL) at shift 1: sTDE (eps=0.5) vs. + w."
    assert re.sub(r"<[^>]*>", "", mark_terms(text, set())) == text
