# SPDX-License-Identifier: Apache-2.0
"""The import rule: the house is entered from the top only, and the core knows neither files nor ROS."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "limbloc_ros"

#: Which of our packages a package may import, besides itself.
ALLOWED = {
    "core": set(),
    "rig": {"core"},
    "simulation": {"core", "rig"},
    "recordings": {"core", "rig"},
    "export": {"core", "rig", "recordings"},
    "report": {"core", "rig", "recordings", "export"},
    "ros": {"core", "rig", "recordings"},
    "nodes": {"core", "rig", "simulation", "recordings", "ros"},
    "commands": {"core", "rig", "simulation", "recordings", "export", "report", "ros", "nodes"},
}

#: Modules of the core, as the data flows; each may import only what stands before it.
CORE_ORDER = (
    "errors",
    "interrupts",
    "config",
    "camera",
    "lens",
    "pose",
    "mask_png",
    "images",
    "synchroniser",
    "background_evidence",
    "mask_cleaning",
    "segmentation",
    "relight",
    "background_estimate",
    "background",
    "silhouettes",
    "views",
    "mending",
    "hull",
    "surface",
    "geodesic",
    "figure",
    "flesh_mesh",
    "simplex",
    "lm",
    "energy",
    "priors",
    "paper_energy",
    "directions",
    "anchors",
    "limb_search",
    "search",
    "limb_pairs",
    "engine_paper",
    "engine_robust",
    "tracker",
    "joint_angles",
    "ros4hri",
    "posture",
    "unexplained",
    "shown",
    "confidence",
    "pipeline",
    "parts",
    "people",
)

#: What each package may import from outside the standard library.
NUMERIC = {"numpy", "scipy", "cv2", "numba", "llvmlite"}  # the last is numba's own language
ROS = {
    "rclpy",
    "builtin_interfaces",
    "diagnostic_msgs",
    "geometry_msgs",
    "rcl_interfaces",
    "rosgraph_msgs",
    "sensor_msgs",
    "std_msgs",
    "std_srvs",
    "visualization_msgs",
    "tf2_ros",
    "tf2_msgs",
    "hri_msgs",
    "ament_index_python",
}
OUTSIDE = {
    "core": NUMERIC,
    "rig": NUMERIC | {"yaml", "matplotlib", "mpl_toolkits"},
    "simulation": NUMERIC,
    "recordings": NUMERIC | {"rosbags", "distributed"},
    "export": NUMERIC | {"ezc3d"},
    "report": NUMERIC | {"matplotlib", "mpl_toolkits", "open3d"},
    "ros": NUMERIC | ROS,
    "nodes": NUMERIC | ROS | {"foxglove"},
    "commands": NUMERIC | ROS | {"yaml", "tqdm"},
}

MODULES = sorted(PACKAGE.rglob("*.py"))


def imports(path):
    """Absolute names of everything that a module imports, also inside functions: `package.module[.name]`."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path.name}: relative import in line {node.lineno}"
            found |= {f"{node.module}.{alias.name}" for alias in node.names}
    return found


def part_of(path):
    """The package of ours that a file belongs to, `` for the top level."""
    relative = path.relative_to(PACKAGE)
    return relative.parts[0] if len(relative.parts) > 1 else ""


@pytest.mark.parametrize("path", [p for p in MODULES if part_of(p)], ids=lambda p: str(p.relative_to(PACKAGE)))
def test_imports_run_one_way(path):
    here = part_of(path)
    assert here in ALLOWED, f"new package {here}: say here what it may import"
    for name in imports(path):
        top, _, rest = name.partition(".")
        if top == "limbloc_ros":
            there = rest.split(".")[0]
            assert there != "files" or here != "core", f"{here} writes no files"
            if there and (PACKAGE / there).is_dir():
                assert there == here or there in ALLOWED[here], f"{here} must not import {name}"
        elif top not in sys.stdlib_module_names:
            assert top in OUTSIDE[here], f"{here} must not import {top}"


def core_imports(path):
    """The modules of the core that a module of the core imports."""
    parts = [name.split(".") for name in imports(path)]
    ours = {p for names in parts if names[:2] == ["limbloc_ros", "core"] for p in names[2:4]}
    return {name for name in ours if (PACKAGE / "core" / f"{name}.py").is_file()}


def core_ranks():
    """Where each module of the core stands; a private one just before the first public one that leads to it."""
    graph = {p.stem: core_imports(p) for p in MODULES if part_of(p) == "core" and p.stem != "__init__"}
    unknown = [name for name in graph if not name.startswith("_") and name not in CORE_ORDER]
    assert not unknown, f"give {unknown} a place in CORE_ORDER"
    ranks = {}
    for rank, public in enumerate(name for name in CORE_ORDER if name in graph):
        ranks[public] = rank
        reached = [name for name in graph[public] if name.startswith("_")]
        while reached:
            name = reached.pop()
            if name not in ranks:
                ranks[name] = rank - 0.5
                reached += [other for other in graph[name] if other.startswith("_")]
    return graph, ranks


def test_the_core_runs_down_the_data_flow():
    graph, ranks = core_ranks()
    for name, imported in graph.items():
        assert name in ranks, f"nothing imports core/{name}.py"
        for other in imported:
            beside = other.startswith("_") and name.startswith("_")
            assert ranks[other] < ranks[name] or (beside and ranks[other] == ranks[name]), (
                f"core/{name}.py imports {other}, which comes later in the data flow"
            )


def test_offline_processing_needs_no_ros():
    script = (
        "import sys\n"
        "import limbloc_ros.commands.process, limbloc_ros.commands.report\n"
        f"ros = {sorted(ROS)!r}\n"
        "print(sorted(m for m in sys.modules if m.split('.')[0] in ros))\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, cwd=PACKAGE.parent, check=False
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == "[]"


def test_every_source_file_names_its_licence_and_says_what_it_is():
    for path in [*MODULES, *Path(__file__).parent.glob("*.py")]:
        text = path.read_text()
        assert text.startswith("# SPDX-License-Identifier: Apache-2.0\n"), path
        assert ast.get_docstring(ast.parse(text)), f"{path}: no module docstring"


def test_no_file_grows_into_a_monolith():
    for path in MODULES:
        assert len(path.read_text().splitlines()) <= 500, path
