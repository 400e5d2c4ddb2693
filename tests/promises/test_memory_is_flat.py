"""Memory does not grow with the length of training: not within a compiled chunk, nor from one chunk to the next."""

import functools
import gc

import jax
import pytest
from support.rollouts import CONFIG, KNOWLEDGE, LEARNER, PARAMS

SCALARS = CONFIG.scalars(1000)
MAX_GROWTH = 16 * 1024  # bytes: the metrics of the updates of a chunk


@pytest.fixture(scope="module")
def state():
    return jax.jit(LEARNER.init)(jax.random.key(0), PARAMS, KNOWLEDGE)


def train_and_keep_params(state, scalars, params, knowledge, num_updates):
    """Train as `Learner.train` does, but keep the parameters of every update."""

    def step(state, _):
        state, _ = LEARNER.update(state, scalars, params, knowledge)
        return state, state.params

    return jax.lax.scan(step, state, None, length=num_updates)


def measure_chunk_bytes(train, state, num_updates):
    """Bytes of the results and intermediate values of a compiled chunk."""
    chunk = jax.jit(functools.partial(train, num_updates=num_updates))
    memory = chunk.lower(state, SCALARS, PARAMS, KNOWLEDGE).compile().memory_analysis()
    assert memory is not None
    return memory.temp_size_in_bytes + memory.output_size_in_bytes


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.parametrize(("train", "is_flat"), [(LEARNER.train, True), (train_and_keep_params, False)])
def test_chunk_memory_is_independent_of_the_number_of_updates(state, train, is_flat):
    short_bytes = measure_chunk_bytes(train, state, 2)
    long_bytes = measure_chunk_bytes(train, state, 20)
    print(f"{short_bytes} bytes for 2 updates, {long_bytes} for 20")
    assert (long_bytes - short_bytes <= MAX_GROWTH) == is_flat


@pytest.mark.slow
def test_chunks_leave_no_live_arrays(state):
    train = jax.jit(functools.partial(LEARNER.train, num_updates=2))
    live_bytes = []
    for _ in range(11):
        state, metrics = train(state, SCALARS, PARAMS, KNOWLEDGE)
        del metrics
        gc.collect()
        live_bytes.append(sum(array.nbytes for array in jax.live_arrays()))

    # The first chunk is a warm-up; all later ones leave equally many bytes.
    assert len(set(live_bytes[1:])) == 1
