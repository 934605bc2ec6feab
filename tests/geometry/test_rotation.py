from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from hrcreplay.geometry.vectors import to_vector


@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-6, 0.3, 2.0, np.pi - 1e-6, np.pi - 1e-12])
def test_rotation_vectors_there_and_back(angle: float) -> None:
    rng = np.random.default_rng(1)
    for axis in (*np.eye(3), *-np.eye(3), *rng.normal(size=(20, 3))):
        vector = angle * axis / np.linalg.norm(axis)
        R = Rotation.from_rotvec(vector).as_matrix()
        assert_allclose(to_vector(R), vector, rtol=1e-9, atol=1e-15)


def test_half_a_turn_is_one_of_its_two_vectors() -> None:
    for axis in np.eye(3):
        R = 2 * np.outer(axis, axis) - np.eye(3)
        assert_allclose(np.abs(to_vector(R)), np.pi * axis, atol=1e-15)
