# SPDX-License-Identifier: Apache-2.0
"""Fit the figure's flesh to visual hulls: the second half of making `limbloc_ros/core/proportions.npz`.

`fit_proportions.py` learns the flesh from skins. But what a figure is fitted to is a hull: larger than the body, most
of all in the bends of knees and elbows, and carved from a handful of cameras; so a figure with the flesh of a skin,
fitted to a hull, has joints some millimetres beside the true ones. Here many simulated people (`bake_population.py`)
move before random cameras. With their joints held where they truly are the spheres are moved and resized, on average
and with each of the directions in which people differ, until the energy of all hulls together is as low as it gets.
Then a fit has no reason to move the joints away from there.

    python tools/fit_flesh.py body.npz movable.npz limbloc_ros/core/proportions.npz

`body.npz` is what `fit_proportions.py` writes. Takes about ten minutes on one core, and 2 GB.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from tqdm import tqdm

from limbloc_ros.core import _energy_kernels, energy, figure
from limbloc_ros.core._figure_topology import JOINT_BONES
from limbloc_ros.core._surface_fit_kernels import surface_term
from limbloc_ros.core.camera import Camera, Rig
from limbloc_ros.core.energy import Evidence, Weights
from limbloc_ros.core.engine_robust import fit_from_scratch, gather_evidence, refine
from limbloc_ros.core.figure import BONE, N_SPHERES, SPHERE_NAMES, FigureState
from limbloc_ros.core.hull import Hull, largest_component
from limbloc_ros.core.lm import System
from limbloc_ros.core.pipeline import Carver
from limbloc_ros.core.pose import JOINT_NAMES
from limbloc_ros.core.priors import KnownSize
from limbloc_ros.core.surface import extract_surface
from limbloc_ros.rig.geometry import looking_at
from limbloc_ros.simulation.person import Person
from limbloc_ros.simulation.room import SimulatedRoom

Array = np.ndarray
JOINT = {name: k for k, name in enumerate(JOINT_NAMES)}
SIDED = ("shoulder", "elbow", "wrist", "hip", "knee", "ankle")
LIMBS = [JOINT["head_centre"]] + [JOINT[f"{name}_{side}"] for name in SIDED for side in "LR"]

#: How many cameras a person is seen by, in turn: mostly eight.
CAMERAS = (8, 8, 6, 8, 8, 4, 8, 12)
POINTS = 1500
#: How strongly joints are held where they are while the flesh is fitted, as `Inertia.weight`, and how much each of
#: them counts: trunk and extremities, whose definitions are vague, less; fingertips, which curl, not at all.
HOLD = 3.0
SHARE = np.ones(len(JOINT_NAMES))
SHARE[[JOINT[name] for name in ("torso_centre", "neck_base", "pelvis_centre")]] = 0.3
SHARE[[JOINT["head_top"]] + [JOINT[f"{name}_{side}"] for name in ("hand", "toe", "heel") for side in "LR"]] = 0.1
SHARE[[JOINT[f"fingertip_{side}"] for side in "LR"]] = 0.0
#: What it costs (m^2) to change the flesh by one stature, so that spheres which no hull tells about stay.
RIDGE = 0.002
#: Most that a number of the flesh changes in a step, statures; how much steps are damped (Marquardt).
LARGEST, DAMPING = 0.004, 0.3
SMALLEST_RADIUS = 0.006  # statures
#: By what share of its mean a radius may change along all directions together: it stays positive whoever it is.
LARGEST_SPREAD = 0.25


@dataclass(frozen=True)
class HeldJoints:
    """A Prior: the joints are known."""

    joints: Array
    weight: float

    def system(self, state: FigureState) -> System:
        off = (figure.place(state).joints - self.joints).ravel()
        J = figure.place_jacobian(state)[N_SPHERES:, :3].reshape(off.size, -1)
        believed = self.weight * np.repeat(SHARE, 3) / len(SHARE)
        return System(float(believed @ off**2), (J.T * believed) @ off, (J.T * believed) @ J)


@dataclass
class Example:
    """A hull with its true joints, and the figure in it so far."""

    evidence: Evidence
    joints: Array
    shape: Array
    state: FigureState


# people and hulls


def people(path: Path) -> Iterator[Person]:
    """Those of a file of `bake_population.py`."""
    with np.load(path, allow_pickle=False) as file:
        data = {key: file[key] for key in file.files}
    for k in range(len(data["vertices"])):
        yield Person.from_arrays(f"person {k}", data, k)


def random_rig(rng: np.random.Generator, n: int) -> Rig:
    """A ring of cameras at all heights, each a little out of place."""
    start, heights, cameras = rng.uniform(0, 2 * np.pi), rng.permutation(np.linspace(1.0, 2.6, n)), []
    for k in range(n):
        angle = start + 2 * np.pi * (k + rng.uniform(-0.15, 0.15)) / n
        place = rng.uniform(2.6, 2.95) * np.array([np.cos(angle), np.sin(angle)])
        target = np.array([rng.uniform(-0.15, 0.15), rng.uniform(-0.15, 0.15), rng.uniform(0.8, 1.05)])
        T = looking_at(np.array([*place, heights[k]]), target)
        focal, off = rng.uniform(400, 460), rng.normal(0, 4, 2)
        K = np.array([[focal, 0, 319.5 + off[0]], [0, focal, 239.5 + off[1]], [0, 0, 1.0]])
        cameras.append(Camera(f"cam{k}", 640, 480, K, T, np.array([-0.07, 0.02, 0.0, 0.0]), "radtan"))
    return Rig(tuple(cameras), np.array([-1.5, -1.5, 0.0]), np.array([1.5, 1.5, 2.4]))


def hulls_of(person: Person, n_cameras: int, frames: int, rng: np.random.Generator) -> Iterator[tuple[Hull, Array]]:
    """Hulls and true joints at random times; hands, feet and head turn more than the simulated motions have them."""
    rig = random_rig(rng, n_cameras)
    carver, room = Carver(rig), SimulatedRoom(rig, person, seed=int(rng.integers(1 << 20)), empty_s=0.0)
    for t in np.sort(rng.uniform(3.0, room.motion.duration_s, frames)).tolist():
        posed = room.motion.pose(t)
        assert posed is not None
        turned, nod = posed.bone_rotations.copy(), rng.normal(0, 0.25, 3)
        vectors = {
            name: share * nod
            for name, share in zip(("neck01", "neck02", "neck03", "head"), (0.25, 0.5, 0.75, 1.0), strict=True)
        }
        for side in "LR":
            vectors |= {f"wrist.{side}": rng.normal(0, 0.3, 3), f"foot.{side}": rng.normal(0, 0.12, 3)}
        for name, vector in vectors.items():
            turned[person.bone(name)] = turned[person.bone(name)] @ Rotation.from_rotvec(vector).as_matrix()
        posed = person.pose(turned, posed.bone_positions[person.bone("root")])
        hull = carver.carve(room.silhouettes(posed))
        if isinstance(hull, Hull) and hull.cut_area_m2 == 0.0:
            yield largest_component(hull), posed.joints


def likely_shape(joints: Array) -> Array:
    """[1 + K] the shape whose figure has these people's [F, 25, 3] lengths, as far as people are like that."""
    pairs = [
        (f"{a}_{s}", f"{b}_{s}")
        for a, b in (("shoulder", "elbow"), ("elbow", "wrist"), ("hip", "knee"), ("knee", "ankle"))
        for s in "LR"
    ]
    pairs += [("hip_L", "hip_R"), ("shoulder_L", "shoulder_R"), ("head_centre", "head_top"), ("neck_base", "head_top")]
    pairs += [("pelvis_centre", "torso_centre"), ("torso_centre", "neck_base")]
    pairs += [(f"{a}_{s}", b) for a, b in (("shoulder", "neck_base"), ("hip", "pelvis_centre")) for s in "LR"]
    a, b = ([JOINT[pair[end]] for pair in pairs] for end in (0, 1))
    true = np.median(np.linalg.norm(joints[:, a] - joints[:, b], axis=2), axis=0)
    table, standing = figure.proportions(), FigureState.standing(np.zeros(3))

    def off(body: Array) -> Array:
        shape = np.concatenate([body, np.zeros(table.n_shape - len(body))])
        place = figure.place(FigureState(standing.root, standing.rotations, shape)).joints
        return np.concatenate([np.linalg.norm(place[a] - place[b], axis=1) - true, 0.003 * body[1:]])

    found = least_squares(off, standing.shape[: table.clothing_from]).x
    return np.concatenate([found, np.zeros(table.n_shape - len(found))])


def example_of(hull: Hull, joints: Array, shape: Array, seed: int) -> Example | None:
    """With the figure that our own search finds, made such that its joints are the true ones; None if it is lost."""
    surface = extract_surface(hull)
    evidence = gather_evidence(hull, surface, POINTS, np.random.default_rng(seed))
    found = fit_from_scratch(hull, surface, 0)
    if found is None:
        return None
    priors = HeldJoints(joints, 10 * HOLD), KnownSize(shape, np.diag(np.r_[5e-3, np.full(len(shape) - 1, 1e-4)]))
    state = refine(FigureState(found.state.root, found.state.rotations, shape), evidence, Weights(), 30, priors).state
    if np.linalg.norm(figure.place(state).joints - joints, axis=1)[LIMBS].max() > 0.04:
        return None
    return Example(evidence, joints, shape, state)


# flesh

CARRIERS = np.array([BONE[row[1]] for row in figure.SPHERES])
#: The spheres whose sizes are found, [S] which of them each sphere is or mirrors, and what mirroring does to x y z r.
OWN = [k for k, name in enumerate(SPHERE_NAMES) if not name.endswith("_R")]
ROW = np.array(
    [OWN.index(SPHERE_NAMES.index(n[:-1] + "L") if n.endswith("_R") else k) for k, n in enumerate(SPHERE_NAMES)]
)
MIRROR = np.array([[1.0, -1.0 if name.endswith("_R") else 1.0, 1.0, 1.0] for name in SPHERE_NAMES])
#: What of x y z r may change: those in the middle of the body stay there.
FREE = np.array([[1.0, 1.0 if SPHERE_NAMES[k].endswith("_L") else 0.0, 1.0, 1.0] for k in OWN])


def flesh_system(example: Example) -> System:
    """The energy of one figure by the numbers of the flesh [4 * OWN], statures, were its shape the mean one."""
    placed, scale = figure.place(example.state), np.exp(example.state.shape[0])
    J = np.zeros((N_SPHERES, 4, len(OWN), 4))
    for s, row in enumerate(ROW):
        J[s, :3, row, :3] = scale * placed.rotations[CARRIERS[s]] * (MIRROR[s] * FREE[row])[:3]
        J[s, 3, row, 3] = scale
    J = J.reshape(N_SPHERES, 4, -1)
    n, w, e = J.shape[2], Weights(), example.evidence
    A, g = np.zeros((n, n)), np.zeros(n)
    blocks, slopes = np.zeros((figure.N_PARTS, 12, 12)), np.zeros((figure.N_PARTS, 12))
    flesh = (figure.PART_SPHERES, placed.spheres, placed.radii)
    surface = (e.points, e.normals, e.rays, w.surface * e.point_weights, *e.nearest, *flesh)
    cost = surface_term(*surface, w.surface_width_m, w.normal_gate_m, w.surface_inside, blocks, slopes)
    grid = (e.sdf, e.origin, e.voxel_m, w.inclusion_slack_m, w.inclusion_width_m, w.inclusion)
    samples = (energy.INCLUSION_SAMPLES, energy.INCLUSION_PARTS)
    cost += _energy_kernels.inclusion_term(*samples, *flesh, *grid, blocks, slopes)
    _energy_kernels.gather(blocks, slopes, figure.PART_SPHERES, J, A, g)
    return System(float(cost), g, A)


def settle(examples: list[Example], what: str) -> None:
    """Let the figures follow the flesh as it is now, their joints held."""
    for example in tqdm(examples, desc=what, leave=False):
        loose = KnownSize(example.shape, np.diag(np.r_[1e-3, np.full(len(example.shape) - 1, 2e-5)]))
        priors = HeldJoints(example.joints, HOLD), loose
        example.state = refine(example.state, example.evidence, Weights(), 6, priors).state


def improved(change: Array, examples: list[Example]) -> tuple[Array, float]:
    """The change of the flesh [OWN, 4, 1 + K] after another step, and the mean cost (m^2) before it."""
    n, k = 4 * len(OWN), change.shape[2]
    A, g, cost = np.zeros((k * n, k * n)), np.zeros(k * n), 0.0
    for example in examples:
        system = flesh_system(example)
        with_shape = np.concatenate([[1.0], example.state.shape[1:k]])
        A += np.kron(np.outer(with_shape, with_shape), system.matrix) / len(examples)
        g += np.kron(with_shape, system.gradient) / len(examples)
        cost += system.cost / len(examples)
    numbers = change.reshape(n, k).T.ravel()
    g += RIDGE * numbers
    A[np.diag_indices(k * n)] = (A.diagonal() + RIDGE) * (1.0 + DAMPING)
    numbers = numbers - np.clip(np.linalg.solve(A, g), -LARGEST, LARGEST)
    return numbers.reshape(k, n).T.reshape(change.shape), cost


def set_flesh(centres: Array, radii: Array) -> None:
    """Give the figure of this process other flesh: [S, 3, 1 + K] and [S, 1 + K], statures."""
    table = figure.proportions()
    table.point_offsets[:N_SPHERES, :, : centres.shape[2]] = centres
    table.point_radii[:N_SPHERES, : radii.shape[1]] = radii


def joint_offsets(examples: list[Example], names: list[str], before: Array) -> Array:
    """[J, 3, 1 + K] where joints are in their bones, those that are no pivots: the median of where they truly were."""
    off = []
    for example in examples:
        placed = figure.place(example.state)
        missing = (example.joints - placed.joints)[[JOINT[name] for name in names]]
        frames = placed.rotations[[BONE[JOINT_BONES[name]] for name in names]]
        off.append(np.einsum("jik,ji->jk", frames, missing) / np.exp(example.state.shape[0]))
    typical = np.median(off, axis=0)
    out = before.copy()
    for k, name in enumerate(names):
        if not before[k].any():
            continue
        other = names.index(name[:-1] + {"L": "R", "R": "L"}[name[-1]]) if name[-2:] in ("_L", "_R") else k
        out[k, :, 0] += 0.5 * (typical[k] + typical[other] * [1.0, -1.0, 1.0])
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name in ("body", "movable", "output"):
        parser.add_argument(name, type=Path)
    parser.add_argument("--frames", type=int, default=5, help="hulls of each person")
    parser.add_argument("--steps", type=int, default=9)
    arguments = parser.parse_args()
    with np.load(arguments.body, allow_pickle=False) as file:
        body = {key: file[key] for key in file.files}
    centres, radii = body["sphere_centres"].astype(float), body["sphere_radii"].astype(float)
    names, offsets = [str(name) for name in body["joint_names"]], body["joint_offsets"].astype(float)
    set_flesh(centres, radii)
    figure.proportions().point_offsets[N_SPHERES:, :, : offsets.shape[2]] = offsets[
        [names.index(n) for n in JOINT_NAMES]
    ]

    examples: list[Example] = []
    for k, person in enumerate(tqdm(list(people(arguments.movable)), desc="people")):
        rng = np.random.default_rng([11, k])
        seen = list(hulls_of(person, CAMERAS[k % len(CAMERAS)], arguments.frames, rng))
        if seen:
            shape = likely_shape(np.array([joints for _, joints in seen]))
            examples += [e for n, (h, j) in enumerate(seen) if (e := example_of(h, j, shape, 100 * k + n)) is not None]

    change = np.zeros((len(OWN), 4, centres.shape[2]))
    for step in range(arguments.steps):
        settle(examples, f"step {step}")
        change, cost = improved(change, examples)
        of_all = change[ROW] * MIRROR[:, :, None] * FREE[ROW][:, :, None]
        grown = radii + of_all[:, 3]
        grown[:, 0] = np.maximum(grown[:, 0], SMALLEST_RADIUS)
        set_flesh(centres + of_all[:, :3], grown)
        print(f"before step {step}: {len(examples)} hulls, mean energy {1e4 * cost:.3f} cm^2")

    spread = np.linalg.norm(grown[:, 1:], axis=1, keepdims=True)
    grown[:, 1:] *= np.minimum(1.0, LARGEST_SPREAD * grown[:, :1] / spread)
    body["sphere_centres"], body["sphere_radii"] = (a.astype(np.float32) for a in (centres + of_all[:, :3], grown))
    body["joint_offsets"] = joint_offsets(examples, names, offsets).astype(np.float32)
    set_flesh(body["sphere_centres"], body["sphere_radii"])  # the one that is written
    settle(examples, "at last")
    cost = float(np.mean([flesh_system(example).cost for example in examples]))
    print(f"at last: {len(examples)} hulls, mean energy {1e4 * cost:.3f} cm^2")
    np.savez_compressed(arguments.output, **body)


if __name__ == "__main__":
    main()
