"""Severity of contact, estimated by the two bodies and the spring of ISO/TS 15066:2016, A.3: severity.parquet.

A contact is a stretch of ticks at which the moving robot touches anybody recorded. At each of its ticks the robot is an
effective mass, the touched body region another one behind a spring (``human.contact_limits``), and both approach along
the normal of the contact. The tick with the largest share of the region's force limit stands for the contact. A method
without contact has one row for its nearest tick: what a contact at that instant would have been.

All of it is an estimate. The log says neither how large the area of contact is, so there is no pressure, nor whether
the part can give way: ``transient_n`` is for a part that can, ``clamped_n`` for one that cannot. Motors push on, and
their inertia is in no URDF: both forces may be larger.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields
from itertools import islice

import numpy as np
import pandas as pd
import pyarrow as pa
from numpy.typing import NDArray

from hrcreplay.evaluation.recorded_person import BodyTrack, RecordedPeople
from hrcreplay.geometry.distances import nearest_pair
from hrcreplay.human.contact_limits import Region, region_of
from hrcreplay.human.model import PARTS, part_radii
from hrcreplay.pipeline.robot_mass import RobotMass, recorded_capsules_mass, robot_mass
from hrcreplay.pipeline.run_config import RunConfig
from hrcreplay.records import Bools, Floats, Ints
from hrcreplay.robot.model import RobotModel
from hrcreplay.robot.recorded import RecordedCapsules
from hrcreplay.store.columns import Columns
from hrcreplay.store.stored_table import RunTable, number_columns

#: Two stretches of contact with a shorter gap are one contact [s].
MERGED_S = 0.2
#: Forearm -> the hand at its end.
_HAND = {"LRA": "HAND_R", "LLA": "HAND_L"}
CONTACT, NEAREST = "contact", "nearest"
#: Ticks whose bodies are placed together.
_BATCH = 4096
#: Columns of contact.parquet that it needs.
MET = ("t_ns", "moving", "distance_m", "source")


@dataclass(frozen=True)
class Impact:
    """A contact at one tick; NaN: not known. Fields are columns of severity.parquet."""

    t_ns: int
    method: str
    kind: str  #: CONTACT; NEAREST: no contact, but the nearest tick
    duration_s: float  #: of the whole contact; 0 for the nearest tick [s]
    source: str  #: of the body, as in contact.parquet
    link: str
    limb: str  #: one of PARTS
    region: str  #: of ``human.contact_limits``
    distance_m: float  #: between the surfaces, negative in overlap [m]
    robot_speed: float  #: of the link along the normal, towards the body [m/s]
    person_speed: float  #: of the body along the normal, towards the robot [m/s]
    robot_kg: float  #: effective mass along the normal, by the URDF's inertias [kg]
    robot_simple_kg: float  #: effective mass M / 2 + m_L [kg]
    person_kg: float  #: effective mass of the region [kg]
    stiffness_n_per_m: float  #: spring constant of the region [N/m]
    energy_j: float  #: transferred, by ``robot_kg`` [J]
    energy_simple_j: float  #: transferred, by ``robot_simple_kg`` [J]
    energy_limit_j: float  #: at which the spring has the region's largest force [J]
    transient_n: float  #: force if the part can give way, by the larger energy [N]
    transient_limit_n: (
        float  #: largest force of a short contact; of the head, for which there is none, that if clamped [N]
    )
    clamped_n: float  #: force if the part cannot give way, by the robot's own speed and the larger mass [N]
    clamped_limit_n: float  #: largest quasi-static force [N]

    @property
    def relative_speed(self) -> float:
        """Speed at which both approach along the normal [m/s]."""
        return self.robot_speed + self.person_speed

    @property
    def share(self) -> float:
        """``transient_n`` as a share of its limit; NaN: not known."""
        return self.transient_n / self.transient_limit_n


def severity_table(
    run_config: RunConfig,
    robot: RobotModel,
    method: str,
    motion: RunTable,
    contact: pd.DataFrame,
    people: RecordedPeople,
    capsules: RecordedCapsules | None = None,
) -> Columns:
    """Computes the rows of severity.parquet for one motion.

    Args:
        run_config: The run.
        robot: Robot at its base pose in the world.
        method: Method of the motion.
        motion: Rows of a motion table.
        contact: Rows of contact.parquet of the same ticks, at least the columns MET.
        people: Recorded people.
        capsules: The robot as recorded by its capsules, in place of the links of ``robot``; None: no such robot.
    """
    settings = run_config.settings
    mass = robot_mass(settings.robot, robot) if capsules is None else recorded_capsules_mass(settings.robot)
    radii_m = part_radii(settings.prediction, settings.report.leg_radius_m)
    meeting = Meeting(robot, capsules, mass, people.names, people.tracks, radii_m, settings.prediction.hand_m)
    distance, moving = contact["distance_m"].to_numpy(dtype=float), contact["moving"].to_numpy(dtype=bool)
    t_ns = contact["t_ns"].to_numpy()
    found, touching = [], moving & (distance <= 0.0)
    tick_s = float(np.median(np.diff(t_ns))) * 1e-9 if len(t_ns) > 1 else 0.0
    every = meeting.impacts(method, CONTACT, motion, contact, np.flatnonzero(touching))
    for first, last in merged_runs(touching, t_ns):
        ticks = first + np.flatnonzero(touching[first:last])
        impacts = list(islice(every, len(ticks)))
        worst = max(impacts, key=lambda one: (np.nan_to_num(one.share, nan=-1.0), np.nan_to_num(one.relative_speed)))
        found.append(_lasting(worst, float(t_ns[ticks[-1]] - t_ns[ticks[0]]) * 1e-9 + tick_s))
    near = np.where(moving & np.isfinite(distance), distance, np.inf)
    if not found and len(near) and np.isfinite(near.min()):
        found = list(meeting.impacts(method, NEAREST, motion, contact, np.array([int(np.argmin(near))])))
    return severity_columns(found)


def merged_runs(mask: Bools, t_ns: Ints) -> list[tuple[int, int]]:
    """Returns runs of True as (first, past the last); runs at most ``MERGED_S`` apart are one.

    Args:
        mask: (n,).
        t_ns: (n,) instants, increasing [ns].
    """
    edges = np.flatnonzero(np.diff(np.concatenate([[0], mask.astype(np.int8), [0]])))
    found: list[tuple[int, int]] = []
    for first, last in edges.reshape(-1, 2).tolist():
        if found and t_ns[first] - t_ns[found[-1][1] - 1] <= MERGED_S * 1e9:
            found[-1] = (found[-1][0], last)
        else:
            found.append((first, last))
    return found


def _lasting(impact: Impact, duration_s: float) -> Impact:
    return Impact(**{**impact.__dict__, "duration_s": duration_s})


def severity_columns(impacts: Sequence[Impact]) -> Columns:
    """Returns one row per contact."""
    found: Columns = {}
    for field in fields(Impact):
        values = [getattr(one, field.name) for one in impacts]
        if field.type == "str":
            found[field.name] = pa.array(values, type=pa.string())
        else:
            found[field.name] = np.array(values, dtype=np.int64 if field.type == "int" else np.float64)
    return found


@dataclass(frozen=True)
class Meeting:
    """Robot and bodies of a run."""

    robot: RobotModel
    capsules: RecordedCapsules | None  #: the robot as recorded, in place of the links of ``robot``; None: no such robot
    mass: RobotMass
    sources: tuple[str, ...]  #: names of the tracks, as in contact.parquet
    tracks: tuple[BodyTrack, ...]  #: all bodies
    radii_m: Floats  #: (14,) of PARTS [m]
    hand_m: float  #: length of a hand beyond the wrist [m]

    def impacts(self, method: str, kind: str, motion: RunTable, contact: pd.DataFrame, ticks: Ints) -> Iterator[Impact]:
        """Yields the contact at each of some ticks.

        Args:
            method: Method of the motion.
            kind: CONTACT or NEAREST.
            motion: Rows of a motion table.
            contact: Rows of contact.parquet of the same ticks.
            ticks: (k,) rows at which a body is known, increasing.
        """
        t_ns, source = contact["t_ns"].to_numpy()[ticks], contact["source"].iloc[ticks].to_numpy().astype(str)
        here, names = np.zeros(len(motion), dtype=np.bool_), [f"q{i + 1}" for i in range(self.robot.nv)]
        here[ticks] = True
        touched = motion[here]
        q, dq = (np.ascontiguousarray(number_columns(touched, [d + name for name in names])) for d in ("", "d"))
        for first in range(0, len(ticks), _BATCH):
            rows = slice(first, first + _BATCH)
            yield from self._impacts((method, kind), t_ns[rows], q[rows], dq[rows], source[rows])

    def _impacts(
        self, named: tuple[str, str], t_ns: Ints, q: Floats, dq: Floats, source: NDArray[np.str_]
    ) -> Iterator[Impact]:
        """Yields the contact at each of some ticks.

        Args:
            named: Method, and CONTACT or NEAREST.
            t_ns: (k,) the ticks [ns].
            q: (k, nv) positions of the axes [rad].
            dq: (k, nv) their velocities [rad/s].
            source: (k,) name of the track of the body that is nearest.
        """
        method, kind = named
        ends_m, velocity, radius_m, links = self._links(q, dq, t_ns)
        half_ns, around_m = self._around(t_ns, source)
        for i in range(len(t_ns)):
            axes_m = around_m[i, 1]
            pair = nearest_pair(ends_m[i : i + 1], radius_m[i], axes_m[None], self.radii_m)
            link, part = int(pair.first[0]), int(pair.second[0])
            at_m, body_m = pair.at_first_m[0], pair.at_second_m[0]
            apart = body_m - at_m
            length = float(np.linalg.norm(apart))
            normal = apart / length if length > 0.0 else np.full(3, np.nan)
            along = _share(ends_m[i, link], at_m)
            speed = (1.0 - along) * velocity[i, link, 0] + along * velocity[i, link, 1]
            body_speed = _velocity(around_m[i, :, part], int(half_ns[i]), _share(axes_m[part], body_m))
            limb = PARTS[part]
            in_hand = limb in _HAND and np.linalg.norm(axes_m[part, 1] - body_m) < self.hand_m
            region = region_of(_HAND[limb] if in_hand else limb)
            robot_kg = np.nan
            if self.capsules is None:
                point_m = at_m + radius_m[i, link] * normal
                robot_kg = self.robot.effective_mass_kg(q[i], link, point_m, normal, self.mass.payload_kg)
            yield _impact(
                {
                    "t_ns": int(t_ns[i]),
                    "method": method,
                    "kind": kind,
                    "duration_s": 0.0,
                    "source": str(source[i]),
                    "link": links[link],
                    "limb": limb,
                    "distance_m": float(pair.distance_m[0]),
                },
                region,
                (float(speed @ normal), float(-body_speed @ normal)),
                (robot_kg, self.mass.simple_kg),
            )

    def _links(self, q: Floats, dq: Floats, t_ns: Ints) -> tuple[Floats, Floats, Floats, tuple[str, ...]]:
        """Ends (n, s, 2, 3) of the links' axes [m], their velocities [m/s], radii (n, s) [m], and names."""
        if self.capsules is not None:
            sample = self.capsules.sample(t_ns)
            return sample.ends_m, sample.velocity, sample.radius_m, self.capsules.names
        motion, segments = self.robot.link_motion(q, dq), self.robot.segments
        turning = np.cross(motion.twist[:, :, None, 3:], motion.ends_m)
        radius_m = np.tile([segment.radius_m for segment in segments], (len(q), 1))
        names = tuple(segment.name for segment in segments)
        return motion.ends_m, motion.twist[:, :, None, :3] + turning, radius_m, names

    def _around(self, t_ns: Ints, source: NDArray[np.str_]) -> tuple[Ints, Floats]:
        """Axes of the bodies one sample before some instants, at them, and one after.

        Args:
            t_ns: (k,) [ns].
            source: (k,) name of the body's track at each.

        Returns:
            (k,) period of the track's samples [ns], and (k, 3, 14, 2, 3) [m].
        """
        period_ns, axes_m = np.empty(len(t_ns), np.int64), np.empty((len(t_ns), 3, len(PARTS), 2, 3))
        for name in np.unique(source).tolist():
            mine, track = source == name, self.tracks[self.sources.index(name)]
            period_ns[mine] = track.period_ns
            at_ns = t_ns[mine, None] + track.period_ns * np.arange(-1, 2)
            axes_m[mine] = track.axes_m(at_ns.ravel(), self.hand_m).reshape(-1, *axes_m.shape[1:])
        return period_ns, axes_m


def _velocity(axes_m: Floats, step_ns: int, along: float) -> Floats:
    """(3,) mean velocity of a point of a part, from the first known instant to the last one; NaN: unknown [m/s].

    Args:
        axes_m: (3, 2, 3) axis of the part at three instants [m].
        step_ns: Time between them [ns].
        along: Position of the point along the axis, 0 to 1.
    """
    points_m = (1.0 - along) * axes_m[:, 0] + along * axes_m[:, 1]
    known = np.flatnonzero(np.isfinite(points_m).all(axis=1))
    if len(known) < 2 or not step_ns:
        return np.full(3, np.nan)
    first, last = known[0], known[-1]
    return np.asarray((points_m[last] - points_m[first]) / ((last - first) * step_ns * 1e-9))


def _share(ends_m: Floats, point_m: Floats) -> float:
    """Position of a point of a segment (2, 3) along it, 0 to 1."""
    along = ends_m[1] - ends_m[0]
    length2 = float(along @ along)
    return float(np.clip((point_m - ends_m[0]) @ along / length2, 0.0, 1.0)) if length2 > 0.0 else 0.0


def _impact(
    named: dict[str, object], region: Region, speeds: tuple[float, float], masses: tuple[float, float]
) -> Impact:
    """The contact of a robot and a region.

    Args:
        named: The fields that say which contact it is.
        region: Region that is hit.
        speeds: Of robot and body towards each other, along the normal [m/s].
        masses: Effective mass of the robot by inertia and by the simple form; NaN: not known [kg].
    """
    relative = max(0.0, sum(speeds)) if np.isfinite(sum(speeds)) else np.nan
    energies = [transferred_j(region.mass_kg, mass, relative) for mass in masses]
    known = [mass for mass in masses if not np.isnan(mass)]
    most_kg = max(known) if known else np.nan
    most_j = transferred_j(region.mass_kg, most_kg, relative)
    own = max(0.0, speeds[0]) if np.isfinite(speeds[0]) else np.nan
    stiffness = region.stiffness_n_per_m
    return Impact(
        **named,  # type: ignore[arg-type]
        region=region.name,
        robot_speed=speeds[0],
        person_speed=speeds[1],
        robot_kg=masses[0],
        robot_simple_kg=masses[1],
        person_kg=region.mass_kg,
        stiffness_n_per_m=stiffness,
        energy_j=energies[0],
        energy_simple_j=energies[1],
        energy_limit_j=region.energy_j,
        transient_n=float(np.sqrt(2.0 * most_j * stiffness)),
        transient_limit_n=region.transient_n,
        clamped_n=float(own * np.sqrt(most_kg * stiffness)),
        clamped_limit_n=region.clamped_n,
    )


def transferred_j(person_kg: float, robot_kg: float, relative_speed: float) -> float:
    """Energy that the spring between two free bodies takes up at most, 1/2 mu v^2 [J].

    Args:
        person_kg: Effective mass of the body region [kg].
        robot_kg: Effective mass of the robot; inf: it does not give way; NaN: not known [kg].
        relative_speed: Speed at which they approach, 0 or more [m/s].
    """
    reduced_kg = person_kg if np.isinf(robot_kg) else person_kg * robot_kg / (person_kg + robot_kg)
    return 0.5 * reduced_kg * relative_speed**2
