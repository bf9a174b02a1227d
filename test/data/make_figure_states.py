# SPDX-License-Identifier: Apache-2.0
"""Make figure_states.npz: what the pipeline fits to benchmark people, as realistic postures for tests.

    python test/data/make_figure_states.py SUITES_DIR test/data/figure_states.npz

Of every second frame of the public poses, some of a walk and of a dance, those fits are kept whose joints are
within 5 cm of the truth on average. Rotations are kept as rotation vectors, float32.
"""

import sys
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from limbloc_ros.core.config import FitConfig, HullConfig
from limbloc_ros.core.figure import FigureState
from limbloc_ros.core.pipeline import Carver, PoseEstimator
from limbloc_ros.core.pose import JOINT, Pose
from limbloc_ros.recordings.cases import load_case


def main() -> None:
    suites, out = Path(sys.argv[1]), Path(sys.argv[2])
    frames = {path: range(0, 20, 2) for path in sorted((suites / "public").glob("poses_*"))}
    frames[suites / "public" / "seq_walk_circle"] = range(0, 30, 3)
    frames[suites / "public_motion" / "mocap_dance_b"] = range(0, 66, 8)
    rows, names = [], []
    for path, chosen in frames.items():
        case = load_case(path)
        carver, estimator = Carver(case.rig, HullConfig()), PoseEstimator(FitConfig())
        for f in chosen:
            pose = estimator.estimate(carver.carve(case.masks(f)))
            if not isinstance(pose, Pose):
                continue
            error = np.mean([np.linalg.norm(pose.joint(name) - case.truth[name][f]) for name in JOINT])
            if error < 0.05:
                state = FigureState.from_vector(pose.parameters)
                turns = Rotation.from_matrix(state.rotations).as_rotvec()
                rows.append(np.concatenate([state.root, turns.ravel(), state.shape]))
                names.append(f"{path.name}:{f}")
    np.savez_compressed(out, states=np.array(rows, np.float32), names=np.array(names))


if __name__ == "__main__":
    main()
