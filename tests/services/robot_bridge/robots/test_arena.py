"""How far it is to an arena's walls."""

import math

import numpy as np

from services.robot_bridge.robots.arena import Arena


def test_the_distance_is_that_to_the_nearest_wall_on_the_way():
    directions = np.array([0.0, math.pi / 2, math.pi, -math.pi / 2, math.pi / 4, -3 * math.pi / 4])
    distances = Arena(2.2, 1.4, 0.6).distances(0.1, -0.2, directions)
    # East 1.1 - .1, north .7 + .2, west 1.1 + .1, south .7 - .2; diagonally the north and the south wall come first.
    np.testing.assert_allclose(distances, [1.0, 0.9, 1.2, 0.5, 0.9 * math.sqrt(2), 0.5 * math.sqrt(2)])


def test_at_a_wall_there_is_no_way_to_go():
    distances = Arena(2.0, 1.0, 0.6).distances(1.0, 0.0, np.array([0.0, 0.5, math.pi]))
    np.testing.assert_allclose(distances, [0.0, 0.0, 2.0], atol=1e-9)
