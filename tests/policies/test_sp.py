"""Scene priors: graphs that can be written down, and what the graph convolution makes of them."""

import dataclasses
import functools
from typing import cast

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import tiny_world as tiny
from support.scenes import BOOK, CATEGORIES, CHAIR, FRIDGE

from jaxnav.env.objectnav import NUM_PRIORS
from jaxnav.errors import InputError
from jaxnav.policies.features import NUM_FEATURES, unpack_features
from jaxnav.policies.methods import METHODS, find_method
from jaxnav.policies.methods.sp import (
    GraphConvolution,
    graph_from_file,
    learn_graph,
    learn_permuted_graph,
    normalize_adjacency,
)
from jaxnav.policies.network import bind
from jaxnav.policies.spec import PolicySpec, Sizes
from jaxnav.scenes.tables.compile import compile_bank
from jaxnav.scenes.tables.observation_row import RowFormat
from jaxnav.scenes.worlds import WORLDS, make_generated_scenes

K = len(CATEGORIES)
#: Book and chair stand together, and chair and fridge: with loops the row sums are 2, 3 and 2.
PATH = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 1.0], [0.0, 1.0, 0.0]])
MIXING = np.array([[1 / 2, 6**-0.5, 0], [6**-0.5, 1 / 3, 6**-0.5], [0, 6**-0.5, 1 / 2]])


def counted(kitchen, bedroom=None):
    """Counts of exploration, of poses that show the categories of a line."""
    counts = np.zeros((NUM_PRIORS, K, K), np.float32)
    for room, poses in enumerate((kitchen, bedroom or [])):
        shown = np.zeros((len(poses), K), np.float32)
        for pose, categories in enumerate(poses):
            shown[pose, list(categories)] = 1.0
        counts[room] = shown.T @ shown
    return counts


# The graph


def test_the_graph_is_normalised_symmetrically_with_loops():
    np.testing.assert_allclose(normalize_adjacency(PATH), MIXING, rtol=1e-15)
    np.testing.assert_array_equal(normalize_adjacency(np.zeros((2, K, K))), np.stack([np.eye(K)] * 2))
    # Weights: the row sums are 1.5, 2.5 and 2.
    mixing = normalize_adjacency(np.array([[0, 0.5, 0], [0.5, 0, 1], [0, 1, 0]]))
    np.testing.assert_allclose(np.diagonal(mixing), [1 / 1.5, 1 / 2.5, 1 / 2])
    np.testing.assert_allclose(mixing[BOOK, CHAIR], 0.5 / (1.5 * 2.5) ** 0.5)


def test_edges_are_shares_of_poses_over_all_rooms():
    """Book at 4 poses, chair at 9, together at 3: 3 / sqrt(4 x 9) = 1/2. The fridge is alone."""
    kitchen = [(BOOK, CHAIR)] * 2 + [(CHAIR,)] * 4 + [(FRIDGE,)]
    bedroom = [(BOOK, CHAIR)] + [(CHAIR,)] * 2 + [(BOOK,)]
    learned = learn_graph([], counted(kitchen, bedroom))
    assert learned["mixing"].dtype == np.float32
    edges = np.array([[0, 0.5, 0], [0.5, 0, 0], [0, 0, 0]])
    np.testing.assert_allclose(learned["mixing"], normalize_adjacency(edges), rtol=1e-6)
    # A room twice as often explored counts twice, and one prior for all rooms changes nothing.
    everywhere = np.repeat(counted(kitchen, bedroom).sum(axis=0)[None], NUM_PRIORS, axis=0)
    np.testing.assert_allclose(learn_graph([], everywhere)["mixing"], learned["mixing"], rtol=1e-6)
    nowhere = learn_graph([], np.zeros((NUM_PRIORS, K, K)))  # nothing was ever detected
    np.testing.assert_array_equal(nowhere["mixing"], np.eye(K))


def test_permuted_edges_are_those_of_another_category():
    counts = counted([(BOOK, CHAIR)] * 3 + [(CHAIR, FRIDGE)])
    mixing, permuted = (learn([], counts)["mixing"] for learn in (learn_graph, learn_permuted_graph))
    for one in range(K):
        for other in range(K):
            assert permuted[(one + 1) % K, (other + 1) % K] == mixing[one, other]
    assert np.abs(mixing - permuted).max() > 0.1
    assert find_method("jaxnav.policies.methods.sp:PERMUTED").learn is learn_permuted_graph


# A file of edges


def test_edges_are_read_from_a_file(tmp_path):
    path = tmp_path / "edges.csv"
    path.write_text("# what I know\n\nBook,Chair\n Fridge , Chair, 0.5  # in kitchens\n")
    learned = graph_from_file(path, [tiny.BANK], np.zeros((NUM_PRIORS, K, K)))
    np.testing.assert_allclose(
        learned["mixing"], normalize_adjacency(np.array([[0, 1, 0], [1, 0, 0.5], [0, 0.5, 0]])), rtol=1e-6
    )


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("Book,Chair\nBook,Chiar", ":2: category 'Chiar' is unknown; did you mean 'Chair'?"),
        ("Zebra,Book", ":1: category 'Zebra' is unknown; choose of Book, Chair, Fridge, or take the line out"),
        ("\nBook", ":2: 'Book' is no edge; name two categories, such as Book,Chair"),
        ("Book,Book", ":1: 'Book,Book' is no edge; name two categories, such as Book,Chair"),
        ("Book,Chair,1,1", ":1: 'Book,Chair,1,1' is no edge; name two categories, such as Book,Chair"),
        *[
            (f"Book,Chair,{weight}", f":1: weight {weight!r} is not above 0 and at most 1; mend it or leave it out")
            for weight in ("0", "-1", "2", "nan", "much", "")
        ],
        ("# none\n", ": has no edges; write one a line, such as Book,Chair"),
        (None, ": cannot be read (No such file or directory); check the path"),
    ],
)
def test_bad_edges_are_refused_by_file_line_and_mend(text, message, tmp_path):
    path = tmp_path / "edges.csv"
    if text is not None:
        path.write_text(text)
    with pytest.raises(InputError) as refusal:
        graph_from_file(path, [tiny.BANK], np.zeros((NUM_PRIORS, K, K)))
    assert str(refusal.value) == f"{path}{message}"


def test_a_method_of_ones_own_reads_its_file(tmp_path):
    (tmp_path / "edges.csv").write_text("Book,Chair")
    learn = functools.partial(graph_from_file, tmp_path / "edges.csv")
    mine = dataclasses.replace(METHODS["sp"], learn=learn)
    assert mine.learn is not None
    assert mine.learn([tiny.BANK], np.zeros((NUM_PRIORS, K, K)))["mixing"][BOOK, CHAIR] == 0.5
    assert hash(mine) != hash(METHODS["sp"])


# The graph convolution


def module(spec, weights):
    return cast(GraphConvolution, bind(spec, weights).method)


SPEC = dataclasses.replace(tiny.SPEC, method=METHODS["sp"], method_sizes=())
SP = module(SPEC, tiny.random_params(0, SPEC))
APPEARANCE = bind(SPEC, tiny.random_params(0, SPEC)).appearance.embedding[...]


def seen(*categories, goal=FRIDGE):
    """Features of a view that detects categories."""
    row = np.array(tiny.BANK.rows[0])
    row[: 4 * K] = 0
    for category in categories:
        row[4 * category : 4 * category + 4] = 200, 10, 120 + category, 30
    return unpack_features(jnp.asarray(row), jnp.int32(goal), RowFormat(K))


def experience(view, mixing, weights=None):
    weights = jnp.ones(K) if weights is None else jnp.asarray(weights, jnp.float32)
    return np.asarray(SP.encode(view, APPEARANCE, weights, jnp.asarray(mixing, jnp.float32)))


@pytest.mark.parametrize(("second", "expected"), [(2.0, [25 / 36, 31 / (18 * 6**0.5), 4 / 9]), (-2.0, [0.0, 0.0, 0.0])])
def test_a_graph_convolution_by_hand(second, expected):
    """One unit a layer, and a book is seen: x = [1, 0, 0] by the feature `visible`, the others' kernels are 0.

    1: relu(M x) = [1/2, 1/r, 0] with r = sqrt 6. 2, times 2: [2 (1/4 + 1/6), 2 (1/2r + 1/3r), 2/6] = [5/6, 5/3r, 1/3].
    3, times -1: -[5/12 + 5/18, 5/6r + 5/9r + 1/3r, 5/18 + 1/6]. It is negative: the last layer has no ReLU. The second
    has: times -2 nothing is left.
    """
    spec = PolicySpec(METHODS["sp"], K, Sizes(hidden=4, view_outputs=2, appearance=1, row_hidden=1, row_outputs=1))
    weights = tiny.random_params(0, spec)
    kernels = {
        "named": jnp.zeros((1, 1)),
        "seen": jnp.zeros((NUM_FEATURES, 1)).at[0].set(1.0),
        "second": jnp.full((1, 1), second),
        "third": jnp.full((1, 1), -1.0),
    }
    weights["method"] = {name: {"kernel": kernel} for name, kernel in kernels.items()}
    mixing = jnp.asarray(MIXING, jnp.float32)
    result = module(spec, weights).encode(seen(BOOK), jnp.ones((K, 1)), jnp.ones(K), mixing)
    np.testing.assert_allclose(result, -np.array(expected), rtol=1e-6)


def test_the_graph_convolution_is_that_of_numpy():
    """With all of its inputs, for a batch."""
    view, draws = seen(BOOK, CHAIR), np.random.default_rng(0)
    mixing = normalize_adjacency(np.abs(draws.normal(size=(K, K))) * (1 - np.eye(K)))
    kernel = {name: np.asarray(getattr(SP, name).kernel[...], float) for name in ("named", "seen", "second", "third")}
    nodes = np.asarray(view.table, float) @ kernel["seen"] + np.asarray(APPEARANCE, float) @ kernel["named"]
    nodes = np.maximum(mixing @ nodes, 0)
    nodes = mixing @ np.maximum(mixing @ nodes @ kernel["second"], 0) @ kernel["third"]
    np.testing.assert_allclose(experience(view, mixing), nodes[:, 0], rtol=1e-4)
    many = jax.tree.map(lambda leaf: jnp.stack([leaf] * 5), view)
    batch = SP.encode(many, APPEARANCE, jnp.ones((5, K)), jnp.asarray(np.stack([mixing] * 5), jnp.float32))
    np.testing.assert_allclose(batch, np.stack([nodes[:, 0]] * 5), rtol=1e-4)


def test_permuting_the_edges_changes_the_experience():
    view = seen(BOOK)
    first, second = experience(view, MIXING), experience(view, np.roll(MIXING, 1, axis=(0, 1)))
    assert (np.abs(first - second) > 1e-2 * np.abs(first).max()).all()


def test_categories_hear_of_those_they_are_joined_to():
    """A detection reaches the ends of a path of two edges; without edges it stays where it is."""
    alone = experience(seen(CHAIR), np.eye(K)) != experience(seen(BOOK, CHAIR), np.eye(K))
    assert alone.tolist() == [True, False, False]
    apart = normalize_adjacency(np.array([[0, 1.0, 0], [1.0, 0, 0], [0, 0, 0]]))
    joined = experience(seen(CHAIR), apart) != experience(seen(BOOK, CHAIR), apart)
    assert joined.tolist() == [True, True, False]
    assert (experience(seen(CHAIR), MIXING) != experience(seen(BOOK, CHAIR), MIXING)).all()
    # What is sought is known too, detected or not, and so is what a category is.
    assert (experience(seen(CHAIR), MIXING) != experience(seen(CHAIR, goal=BOOK), MIXING)).all()
    assert len(set(experience(seen(), np.eye(K)).tolist())) == K


def test_layout_weights_multiply_what_is_made():
    weights = np.array([0.25, 0.0, 1.0])
    view = seen(BOOK, FRIDGE)
    np.testing.assert_allclose(experience(view, MIXING, weights), weights * experience(view, MIXING), rtol=1e-6)
    assert experience(view, MIXING).all()


def test_no_fresh_policy_is_silent():
    """With a ReLU at the end some would be for all categories of this view, and could not learn otherwise."""
    spec = dataclasses.replace(SPEC, sizes=Sizes())
    weights = [tiny.random_params(seed, spec) for seed in range(12)]
    lines = [
        module(spec, w).encode(seen(BOOK), w["appearance"]["embedding"], jnp.ones(K), jnp.asarray(MIXING, jnp.float32))
        for w in weights
    ]
    assert all(np.abs(z).max() > 1e-2 for z in lines)
    assert 1 < sum((np.asarray(z) < 0).all() for z in lines) < 11


# The shipped worlds


@pytest.mark.slow
@pytest.mark.parametrize(("world", "scenes"), [("rooms", 80), ("apartments", 16), ("houses", 10)])
def test_edges_of_training_scenes_hold_in_others_and_permuted_ones_do_not(world, scenes):
    """By the correlation of two graphs over all pairs of categories."""
    task = WORLDS[world].task

    def pairs(learn, split, count):
        world_scenes = make_generated_scenes(world, split, count)
        rows = compile_bank((world_scenes[i] for i in range(count)), task).rows
        shown = RowFormat(len(task.categories)).presence(rows).astype(float)
        mixing = learn([], (shown.T @ shown)[None])["mixing"]
        return mixing[np.triu_indices(len(mixing), 1)]

    others = pairs(learn_graph, "val", scenes // 2)
    assert np.corrcoef(pairs(learn_graph, "train", scenes), others)[0, 1] > 0.7
    assert abs(np.corrcoef(pairs(learn_permuted_graph, "train", scenes), others)[0, 1]) < 0.2
