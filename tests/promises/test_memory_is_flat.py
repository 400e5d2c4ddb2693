"""Memory does not grow with the length of training: not within a compiled chunk, nor from one chunk to the next."""

import functools
import gc

import jax
import pytest
from support.rollouts import CONFIG, KNOWLEDGE, LEARNER, PARAMS

SCALARS = CONFIG.scalars(1000)
SLACK = 16 * 1024  # bytes: the metrics of the updates of a chunk


@pytest.fixture(scope="module")
def state():
    return jax.jit(LEARNER.init)(jax.random.key(0), PARAMS, KNOWLEDGE)


def hoarding(state, scalars, params, knowledge, num_updates):
    """Train as `Learner.train` does, but keep the parameters of every update."""

    def step(state, _):
        state, _ = LEARNER.update(state, scalars, params, knowledge)
        return state, state.params

    return jax.lax.scan(step, state, None, length=num_updates)


def bytes_of(train, state, num_updates):
    """What a compiled chunk needs beside its arguments."""
    call = jax.jit(functools.partial(train, num_updates=num_updates))
    needed = call.lower(state, SCALARS, PARAMS, KNOWLEDGE).compile().memory_analysis()
    assert needed is not None
    return needed.temp_size_in_bytes + needed.output_size_in_bytes


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.parametrize(("train", "flat"), [(LEARNER.train, True), (hoarding, False)])
def test_chunk_memory_is_independent_of_the_number_of_updates(state, train, flat):
    few, many = (bytes_of(train, state, updates) for updates in (2, 20))
    print(f"{few} bytes for 2 updates, {many} for 20")
    assert (many - few <= SLACK) == flat


@pytest.mark.slow
def test_chunks_leave_no_live_arrays(state):
    train = jax.jit(functools.partial(LEARNER.train, num_updates=2))
    held = []
    for _ in range(11):
        state, metrics = train(state, SCALARS, PARAMS, KNOWLEDGE)
        del metrics
        gc.collect()
        held.append(sum(array.nbytes for array in jax.live_arrays()))
    assert len(set(held[1:])) == 1
