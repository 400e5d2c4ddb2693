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

NUM_CATEGORIES = len(CATEGORIES)
NO_COUNTS = np.zeros((NUM_PRIORS, NUM_CATEGORIES, NUM_CATEGORIES))
#: Book and chair stand together, and chair and fridge: with loops the row sums are 2, 3 and 2.
PATH = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 1.0], [0.0, 1.0, 0.0]])
MIXING = np.array([[1 / 2, 6**-0.5, 0], [6**-0.5, 1 / 3, 6**-0.5], [0, 6**-0.5, 1 / 2]])


def count_detections(kitchen_poses, bedroom_poses=()):
    """Counts of exploration [NUM_PRIORS, K, K]; each pose is a tuple of the categories that it shows."""
    counts = np.zeros((NUM_PRIORS, NUM_CATEGORIES, NUM_CATEGORIES), np.float32)
    for room_index, poses in enumerate((kitchen_poses, bedroom_poses)):
        presence = np.zeros((len(poses), NUM_CATEGORIES), np.float32)
        for pose, categories in enumerate(poses):
            presence[pose, list(categories)] = 1.0
        counts[room_index] = presence.T @ presence
    return counts


# The graph


def test_normalize_adjacency_is_symmetric_with_loops():
    np.testing.assert_allclose(normalize_adjacency(PATH), MIXING, rtol=1e-15)
    no_edges = np.zeros((2, NUM_CATEGORIES, NUM_CATEGORIES))
    np.testing.assert_array_equal(normalize_adjacency(no_edges), np.stack([np.eye(NUM_CATEGORIES)] * 2))
    # Weights: the row sums are 1.5, 2.5 and 2.
    mixing = normalize_adjacency(np.array([[0, 0.5, 0], [0.5, 0, 1], [0, 1, 0]]))
    np.testing.assert_allclose(np.diagonal(mixing), [1 / 1.5, 1 / 2.5, 1 / 2])
    np.testing.assert_allclose(mixing[BOOK, CHAIR], 0.5 / (1.5 * 2.5) ** 0.5)


def test_learn_graph_takes_edges_from_shares_of_poses_over_all_rooms():
    """Book at 4 poses, chair at 9, together at 3: 3 / sqrt(4 x 9) = 1/2. The fridge is alone."""
    kitchen_poses = [(BOOK, CHAIR)] * 2 + [(CHAIR,)] * 4 + [(FRIDGE,)]
    bedroom_poses = [(BOOK, CHAIR)] + [(CHAIR,)] * 2 + [(BOOK,)]
    counts = count_detections(kitchen_poses, bedroom_poses)
    mixing = learn_graph([], counts)["mixing"]
    edges = np.array([[0, 0.5, 0], [0.5, 0, 0], [0, 0, 0]])
    assert mixing.dtype == np.float32
    np.testing.assert_allclose(mixing, normalize_adjacency(edges), rtol=1e-6)

    # A room twice as often explored counts twice, and one prior for all rooms changes nothing.
    pooled_counts = np.repeat(counts.sum(axis=0)[None], NUM_PRIORS, axis=0)
    np.testing.assert_allclose(learn_graph([], pooled_counts)["mixing"], mixing, rtol=1e-6)


def test_learn_graph_has_only_loops_without_detections():
    np.testing.assert_array_equal(learn_graph([], NO_COUNTS)["mixing"], np.eye(NUM_CATEGORIES))


def test_learn_permuted_graph_shifts_edges_to_the_next_category():
    counts = count_detections([(BOOK, CHAIR)] * 3 + [(CHAIR, FRIDGE)])
    mixing = learn_graph([], counts)["mixing"]
    permuted_mixing = learn_permuted_graph([], counts)["mixing"]
    np.testing.assert_array_equal(permuted_mixing, np.roll(mixing, 1, axis=(0, 1)))
    assert np.abs(mixing - permuted_mixing).max() > 0.1
    assert find_method("jaxnav.policies.methods.sp:PERMUTED").learn is learn_permuted_graph


# A file of edges


def test_graph_from_file_reads_weights_and_skips_comments(tmp_path):
    path = tmp_path / "edges.csv"
    path.write_text("# my notes\n\nBook,Chair\n Fridge , Chair, 0.5  # in kitchens\n")
    mixing = graph_from_file(path, [tiny.BANK], NO_COUNTS)["mixing"]
    edges = np.array([[0, 1, 0], [1, 0, 0.5], [0, 0.5, 0]])
    np.testing.assert_allclose(mixing, normalize_adjacency(edges), rtol=1e-6)


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        ("Book,Chair\nBook,Chiar", (":2: ", "'Chiar'", "did you mean 'Chair'")),
        ("Zebra,Book", (":1: ", "'Zebra'", "choose one of Book, Chair, Fridge")),
        ("\nBook", (":2: ", "'Book'", "write two categories")),
        ("Book,Book", (":1: ", "'Book,Book'", "write two categories")),
        ("Chair,Stool", (":1: ", "'Chair,Stool'", "write two categories")),  # a stool is a Chair
        ("Book,Chair,1,1", (":1: ", "'Book,Chair,1,1'", "write two categories")),
        ("Book,Chair,0", (":1: weight '0'", "above 0 and at most 1")),
        ("Book,Chair,-1", (":1: weight '-1'", "above 0 and at most 1")),
        ("Book,Chair,2", (":1: weight '2'", "above 0 and at most 1")),
        ("Book,Chair,nan", (":1: weight 'nan'", "above 0 and at most 1")),
        ("Book,Chair,much", (":1: weight 'much'", "above 0 and at most 1")),
        ("Book,Chair,", (":1: weight ''", "above 0 and at most 1")),
        ("# none\n", (": ", "no edges", "write one edge per line")),
        (None, (": ", "No such file or directory", "check the path")),
    ],
)
def test_graph_from_file_refuses_bad_edges_by_file_line_and_remedy(text, parts, tmp_path):
    path = tmp_path / "edges.csv"
    if text is not None:
        path.write_text(text)
    with pytest.raises(InputError) as refusal:
        graph_from_file(path, [tiny.BANK], NO_COUNTS)
    location, *further_parts = parts
    assert str(refusal.value).startswith(f"{path}{location}")
    for part in further_parts:
        assert part in str(refusal.value)


def test_method_can_learn_its_graph_from_a_file(tmp_path):
    (tmp_path / "edges.csv").write_text("Book,Chair")
    learn = functools.partial(graph_from_file, tmp_path / "edges.csv")
    file_method = dataclasses.replace(METHODS["sp"], learn=learn)
    assert file_method.learn is not None
    assert file_method.learn([tiny.BANK], NO_COUNTS)["mixing"][BOOK, CHAIR] == 0.5
    assert hash(file_method) != hash(METHODS["sp"])


# The graph convolution


def bind_graph_convolution(spec, weights):
    return cast(GraphConvolution, bind(spec, weights).method)


SPEC = dataclasses.replace(tiny.SPEC, method=METHODS["sp"], method_sizes=())
GRAPH_CONVOLUTION = bind_graph_convolution(SPEC, tiny.random_params(0, SPEC))
APPEARANCE = bind(SPEC, tiny.random_params(0, SPEC)).appearance.embedding[...]


def make_view(*categories, goal=FRIDGE):
    """Features of a view that detects categories."""
    row = np.array(tiny.BANK.rows[0])
    row[: 4 * NUM_CATEGORIES] = 0
    for category in categories:
        row[4 * category : 4 * category + 4] = 200, 10, 120 + category, 30
    return unpack_features(jnp.asarray(row), jnp.int32(goal), RowFormat(NUM_CATEGORIES))


def encode(view, mixing, layout_weights=(1.0, 1.0, 1.0)):
    """The experience [K] of a view under a mixing matrix [K, K]."""
    weights = jnp.asarray(layout_weights, jnp.float32)
    return np.asarray(GRAPH_CONVOLUTION.encode(view, APPEARANCE, weights, jnp.asarray(mixing, jnp.float32)))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("second_weight", "expected"), [(2.0, [25 / 36, 31 / (18 * 6**0.5), 4 / 9]), (-2.0, [0.0, 0.0, 0.0])]
)
def test_graph_convolution_follows_worked_arithmetic(second_weight, expected):
    """One unit a layer, and a book is seen: x = [1, 0, 0] by the feature `visible`, the others' kernels are 0.

    1: relu(M x) = [1/2, 1/r, 0] with r = sqrt 6. 2, times 2: [2 (1/4 + 1/6), 2 (1/2r + 1/3r), 2/6] = [5/6, 5/3r, 1/3].
    3, times -1: -[5/12 + 5/18, 5/6r + 5/9r + 1/3r, 5/18 + 1/6]. It is negative: the last layer has no ReLU. The second
    has: times -2 nothing is left.
    """
    sizes = Sizes(hidden=4, view_outputs=2, appearance=1, row_hidden=1, row_outputs=1)
    spec = PolicySpec(METHODS["sp"], NUM_CATEGORIES, sizes)
    weights = tiny.random_params(0, spec)
    weights["method"] = {
        "named": {"kernel": jnp.zeros((1, 1))},
        "seen": {"kernel": jnp.zeros((NUM_FEATURES, 1)).at[0].set(1.0)},
        "second": {"kernel": jnp.full((1, 1), second_weight)},
        "third": {"kernel": jnp.full((1, 1), -1.0)},
    }
    graph_convolution = bind_graph_convolution(spec, weights)
    appearance = jnp.ones((NUM_CATEGORIES, 1))
    mixing = jnp.asarray(MIXING, jnp.float32)
    experience = graph_convolution.encode(make_view(BOOK), appearance, jnp.ones(NUM_CATEGORIES), mixing)
    np.testing.assert_allclose(experience, -np.array(expected), rtol=1e-6)


def test_graph_convolution_equals_numpy():
    """With all of its inputs, for one view and for a batch."""
    view = make_view(BOOK, CHAIR)
    random_edges = np.abs(np.random.default_rng(0).normal(size=(NUM_CATEGORIES, NUM_CATEGORIES)))
    mixing = normalize_adjacency(random_edges * (1 - np.eye(NUM_CATEGORIES)))
    kernels = {}
    for name in ("named", "seen", "second", "third"):
        kernels[name] = np.asarray(getattr(GRAPH_CONVOLUTION, name).kernel[...], float)

    # Three layers, [K, units].
    inputs = np.asarray(view.table, float) @ kernels["seen"] + np.asarray(APPEARANCE, float) @ kernels["named"]
    first_layer = np.maximum(mixing @ inputs, 0)
    second_layer = np.maximum(mixing @ first_layer @ kernels["second"], 0)
    expected = (mixing @ second_layer @ kernels["third"])[:, 0]
    np.testing.assert_allclose(encode(view, mixing), expected, rtol=1e-4)

    # Five equal views.
    batch_view = jax.tree.map(lambda leaf: jnp.stack([leaf] * 5), view)
    batch_mixing = jnp.asarray(np.stack([mixing] * 5), jnp.float32)
    batch_experience = GRAPH_CONVOLUTION.encode(batch_view, APPEARANCE, jnp.ones((5, NUM_CATEGORIES)), batch_mixing)
    np.testing.assert_allclose(batch_experience, np.stack([expected] * 5), rtol=1e-4)


def test_permuted_edges_change_the_experience():
    view = make_view(BOOK)
    experience = encode(view, MIXING)
    permuted_experience = encode(view, np.roll(MIXING, 1, axis=(0, 1)))
    assert (np.abs(experience - permuted_experience) > 1e-2 * np.abs(experience).max()).all()


@pytest.mark.parametrize(
    ("adjacency", "is_reached"),
    [
        (np.zeros((3, 3)), [True, False, False]),
        (np.array([[0, 1.0, 0], [1.0, 0, 0], [0, 0, 0]]), [True, True, False]),
        (PATH, [True, True, True]),
    ],
    ids=["no edges", "one edge", "path of two edges"],
)
def test_detection_of_the_book_reaches_categories_along_edges(adjacency, is_reached):
    mixing = normalize_adjacency(adjacency)
    differs = encode(make_view(CHAIR), mixing) != encode(make_view(BOOK, CHAIR), mixing)
    assert differs.tolist() == is_reached


def test_experience_depends_on_the_goal_and_on_the_category():
    goal_differs = encode(make_view(CHAIR), MIXING) != encode(make_view(CHAIR, goal=BOOK), MIXING)
    assert goal_differs.all()
    # Without any detection or edge the appearance tells the categories apart.
    assert len(set(encode(make_view(), np.eye(NUM_CATEGORIES)).tolist())) == NUM_CATEGORIES


def test_layout_weights_multiply_the_experience():
    layout_weights = np.array([0.25, 0.0, 1.0])
    view = make_view(BOOK, FRIDGE)
    experience = encode(view, MIXING)
    assert experience.all()
    np.testing.assert_allclose(encode(view, MIXING, layout_weights), layout_weights * experience, rtol=1e-6)


@pytest.mark.slow
def test_fresh_graph_convolution_has_outputs_of_both_signs():
    """With a ReLU at the end some would be zero for all categories of this view, and could not learn otherwise."""
    spec = dataclasses.replace(SPEC, sizes=Sizes())
    mixing = jnp.asarray(MIXING, jnp.float32)
    num_negative = 0
    for seed in range(12):
        weights = tiny.random_params(seed, spec)
        appearance = weights["appearance"]["embedding"]
        graph_convolution = bind_graph_convolution(spec, weights)
        experience = graph_convolution.encode(make_view(BOOK), appearance, jnp.ones(NUM_CATEGORIES), mixing)
        assert np.abs(experience).max() > 1e-2
        num_negative += bool((np.asarray(experience) < 0).all())
    assert 1 < num_negative < 11


# The shipped worlds


@pytest.mark.exhaustive
@pytest.mark.parametrize(("world_name", "num_scenes"), [("rooms", 80), ("apartments", 16), ("houses", 10)])
def test_graph_of_training_scenes_correlates_with_validation_scenes(world_name, num_scenes):
    """Over all pairs of categories; a permuted graph does not correlate."""
    task = WORLDS[world_name].task

    def learn_edges(learn, split, num_scenes):
        """The entries [K (K - 1) / 2] of the mixing matrix above its diagonal."""
        scenes = make_generated_scenes(world_name, split, num_scenes)
        rows = compile_bank((scenes[index] for index in range(num_scenes)), task).rows
        presence = RowFormat(len(task.categories)).presence(rows).astype(float)
        mixing = learn([], (presence.T @ presence)[None])["mixing"]
        return mixing[np.triu_indices(len(mixing), 1)]

    def correlate(edges, other_edges):
        return np.corrcoef(edges, other_edges)[0, 1]

    validation_edges = learn_edges(learn_graph, "val", num_scenes // 2)
    assert correlate(learn_edges(learn_graph, "train", num_scenes), validation_edges) > 0.7
    assert abs(correlate(learn_edges(learn_permuted_graph, "train", num_scenes), validation_edges)) < 0.2
