"""A map between the small model and itself with other triangles, whose correspondence is known."""

from functools import cache

from bench.support.remeshed import Remeshed, remeshed
from registration.geometry.nonrigid_icp import LADDER, IcpSettings
from registration.topology_map import landmarked
from registration.topology_map.make import MapSettings, map_topologies
from registration.topology_map.topology_map import TopologyMap
from tests.conftest import FIXTURES
from tests.registration.cranium.smooth_heads import tiny

# Triangles of the small model are up to 2 cm large: a vertex that is carried there and back comes less near.
QUICK = MapSettings(icp=IcpSettings(splines=(), ladder=LADDER[::2], steps=2), cycle_mm=2.0)


@cache
def pair() -> Remeshed:
    return remeshed(tiny(), landmarked.read(FIXTURES / "tiny_gnm.npz"))


@cache
def small_map() -> TopologyMap:
    return map_topologies(pair().source, pair().target, QUICK)
