"""Accelerations that a motion wishes for: the families of motions that push the bounds."""

from __future__ import annotations

import numpy as np

from hrcreplay.records import DOF, Floats
from tests.tools.soundness.compiled import kernel
from tests.tools.soundness.joint import A_MAX, A_MIN

#: ``push`` drives a corner of a limb through a side of its volume, ``mutate`` varies the worst motion so far.
FAMILIES = (
    "push",
    "mutate",
    "corner",
    "bang_bang",
    "push",
    "mutate",
    "switching",
    "pieces",
    "push",
    "mutate",
    "sideways",
    "single",
)
CODES = {name: code for code, name in enumerate(sorted(set(FAMILIES)))}
ORDER = np.array([CODES[name] for name in FAMILIES])
PUSH, MUTATE, CORNER, BANG_BANG, SWITCHING, PIECES, SIDEWAYS, SINGLE = (
    CODES[name] for name in ("push", "mutate", "corner", "bang_bang", "switching", "pieces", "sideways", "single")
)


@kernel
def extreme(rng: np.random.Generator, j: int, bounds: Floats) -> float:
    return bounds[A_MAX, j] if rng.random() < 0.5 else bounds[A_MIN, j]


@kernel
def toward(sign: float, j: int, bounds: Floats) -> float:
    """The bound in the direction of a sign; 0 for none."""
    if sign == 0.0:
        return 0.0
    return bounds[A_MAX, j] if sign > 0.0 else bounds[A_MIN, j]


@kernel
def draw(rng: np.random.Generator, family: int, bounds: Floats, wish: Floats) -> None:
    """Writes the accelerations (k, 13) of a family, one row a piece of time; not of ``push`` and ``mutate``."""
    for j in range(DOF):
        _draw_joint(rng, family, j, bounds, wish[:, j])
    if family == SINGLE:
        only = rng.integers(0, DOF)
        wish[:, :only], wish[:, only + 1 :] = 0.0, 0.0
    elif family == SIDEWAYS:
        coast = rng.random() < 0.5
        for j in range(3, DOF):
            if coast or rng.random() < 0.5:
                wish[:, j] = 0.0


@kernel
def _draw_joint(rng: np.random.Generator, family: int, j: int, bounds: Floats, wish: Floats) -> None:
    a = extreme(rng, j, bounds)
    switch = rng.integers(0, len(wish) + 1) if family in (BANG_BANG, SINGLE) else len(wish)
    for k in range(len(wish)):
        if family == PIECES:
            a = rng.uniform(bounds[A_MIN, j], bounds[A_MAX, j])
        elif family == SWITCHING:
            a = extreme(rng, j, bounds)
        elif k == switch:
            a = bounds[A_MIN, j] if a > 0.0 else bounds[A_MAX, j]
        wish[k] = a


@kernel
def push(normal: Floats, jacobian: Floats, bounds: Floats, wish: Floats) -> None:
    """Every joint as hard as it can in the sense that moves a point along a normal (3,); jacobian (3, 13)."""
    for j in range(DOF):
        along = normal[0] * jacobian[0, j] + normal[1] * jacobian[1, j] + normal[2] * jacobian[2, j]
        wish[:, j] = toward(along if abs(along) > 1e-9 else 0.0, j, bounds)


@kernel
def mutate(rng: np.random.Generator, bounds: Floats, wish: Floats) -> None:
    """Changes a few joints from some piece of time on."""
    for _ in range(rng.integers(1, 4)):
        j, first = int(rng.integers(0, DOF)), int(rng.integers(0, len(wish)))
        kind = rng.random()
        a = 0.0 if kind < 0.15 else extreme(rng, j, bounds)
        if kind > 0.85:
            a = rng.uniform(bounds[A_MIN, j], bounds[A_MAX, j])
        for k in range(first, len(wish)):
            wish[k, j] = a
