"""The hierarchical object-to-zone graph (Zhang et al., ICCV 2021)."""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
from flax import nnx

from jaxnav.env.objectnav import NUM_PRIORS
from jaxnav.numerics.product import Linear
from jaxnav.policies.features import Features
from jaxnav.policies.methods.base import Knowledge, Method, Percept
from jaxnav.policies.methods.org import ObjectRelations
from jaxnav.policies.methods.zones import learn_permuted, learn_zones
from jaxnav.policies.spec import PolicySpec
from jaxnav.scenes.tables.observation_row import RowFormat

_PLACES = 3  # current zone, next zone, goal's zone


class Located(NamedTuple):
    """Hold where an episode is in the graph.

    Attributes:
      seen: bool [K], what was detected so far.
      room: int32 [], the room type that it is taken for.
      zone: int32 [], the zone of the view.
      nodes: float32 [Z, K], those of the room type, pulled towards what was seen in each.
    """

    seen: jax.Array
    room: jax.Array
    zone: jax.Array
    nodes: jax.Array


class ZonePath(NamedTuple):
    """Hold what the network reads of the graph.

    Attributes:
      rooms: float32 [..., R], the probabilities of the room types.
      zones: float32 [..., 3, K], what is seen in the current zone, the next one and the goal's, mixed with what is
        seen in those that adjoin.
    """

    rooms: jax.Array
    zones: jax.Array


@dataclasses.dataclass(frozen=True)
class ZoneTracker:
    """Follow the episode through the zones.

    Attributes:
      rate: by which a view pulls the node of its zone.
    """

    rate: float = 0.005

    def init(self, knowledge: Knowledge) -> Located:
        """Return the most frequent room type, its graph untouched."""
        graph = knowledge.method
        seen = jnp.zeros(graph["nodes"].shape[-1], bool)
        room = _log_odds(seen, graph).argmax()
        return Located(seen, room, jnp.int32(0), graph["nodes"][room])

    def update(self, note: Located, knowledge: Knowledge, percept: Percept) -> Located:
        """Take in one view; another room type begins with its graph."""
        graph = knowledge.method
        presence = RowFormat(len(note.seen)).presence(percept.row)
        seen = note.seen | presence
        room = _log_odds(seen, graph).argmax()
        nodes = jnp.where(room == note.room, note.nodes, graph["nodes"][room])
        away = presence.astype(jnp.float32)[None] - nodes
        zone = jnp.square(away).sum(axis=-1).argmin()
        return Located(seen, room, zone, nodes.at[zone].add(self.rate * away[zone]))

    def read(self, note: Located, knowledge: Knowledge, goal: jax.Array) -> ZonePath:
        """Return where the best path to the goal leads."""
        graph = knowledge.method
        sought = note.nodes[:, goal].argmax()
        places = jnp.stack([note.zone, graph["next_zone"][note.room, note.zone, sought], sought])
        mixed = graph["mixing"][note.room, places] @ note.nodes
        return ZonePath(jax.nn.softmax(_log_odds(note.seen, graph)), mixed)


def _log_odds(seen: jax.Array, graph: dict[str, jax.Array]) -> jax.Array:
    """Return those of the room types, float32 [R].

    Each category seen, bool [K], counts once, as drawn from those that are detected in a room type.
    """
    return graph["frequency"] + graph["detected"] @ seen.astype(jnp.float32)


class ZoneRelations(ObjectRelations):
    """Relate the detected categories, the goal and the zones.

    Each category's row of ORG's table gets its entries in the embeddings of three zones, one layer of graph
    convolution. The layout weights multiply them with it.
    """

    columns = ObjectRelations.columns + _PLACES

    def __init__(self, spec: PolicySpec, rngs: nnx.Rngs) -> None:
        super().__init__(spec, rngs)
        self.embed = Linear(spec.num_categories, spec.num_categories, use_bias=False, rngs=rngs)
        self.width = self.maps.width + NUM_PRIORS

    def encode(self, features: Features, appearance: jax.Array, weights: jax.Array, reading: ZonePath) -> jax.Array:
        """Return experience, each category weighted by the layout."""
        zones = jnp.swapaxes(nnx.relu(self.embed(reading.zones)), -1, -2)
        table = jnp.concatenate([features.table, zones], axis=-1)
        return jnp.concatenate([self.relate(features, appearance, weights, table), reading.rooms], axis=-1)


HOZ = Method(ZoneRelations, tracker=ZoneTracker(), learn=learn_zones)
#: HOZ with its zones' relations permuted: the ablation that it must beat.
PERMUTED = Method(ZoneRelations, tracker=ZoneTracker(), learn=learn_permuted)
