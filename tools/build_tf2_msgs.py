# SPDX-License-Identifier: Apache-2.0
"""Build tf2_msgs/msg/TFMessage where ROS 2 comes from wheels, which have everything but this package.

    python tools/build_tf2_msgs.py            into this interpreter's site-packages
    python tools/build_tf2_msgs.py FOLDER     or anywhere else on PYTHONPATH

The wheels hold ROS's own generators, headers and libraries; what is missing is one message of one field, a few seconds
of a C++ compiler's work. On the network it is the same message as an apt ROS's: its type hash is checked.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import sysconfig
import tempfile
from pathlib import Path

import numpy as np

PACKAGE = "tf2_msgs"
IDL = """\
#include "geometry_msgs/msg/TransformStamped.idl"
module tf2_msgs { module msg { struct TFMessage { sequence<geometry_msgs::msg::TransformStamped> transforms; }; }; };
"""
#: What every ROS 2 since Iron says.
TYPE_HASH = "RIHS01_e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087"
#: Packages that TFMessage is made of.
INTERFACES = ("geometry_msgs", "std_msgs", "builtin_interfaces")
TYPE_SUPPORTS = ("rosidl_typesupport_fastrtps_c", "rosidl_typesupport_introspection_c")
VISIBILITY = """\
#pragma once
#include "rosidl_runtime_c/visibility_control.h"
"""
PREFIX = Path(sys.prefix)


def generate(work: Path, package: Path) -> None:
    """Write the C and C++ sources below `work`/include, the Python ones into `package`."""
    os.environ["AMENT_PREFIX_PATH"] = str(PREFIX)  # where the generators look for themselves
    from rosidl_generator_c import generate_c
    from rosidl_generator_py.generate_py_impl import generate_py
    from rosidl_generator_type_description import generate_type_hash
    from rosidl_typesupport_c import generate_c as generate_dispatch
    from rosidl_typesupport_fastrtps_c import generate_typesupport_fastrtps_c
    from rosidl_typesupport_introspection_c import generate_c as generate_introspection

    headers = work / "include" / PACKAGE
    for folder in (work / "msg", headers / "msg", package / "msg"):
        folder.mkdir(parents=True, exist_ok=True)
    (work / "msg" / "TFMessage.idl").write_text(IDL)

    def arguments(generator: str, output: Path) -> str:
        values = {
            "package_name": PACKAGE,
            "output_dir": str(output),
            "template_dir": str(PREFIX / "share" / generator / "resource"),
            "idl_tuples": [f"{work}:msg/TFMessage.idl"],
            "type_description_tuples": [f"msg/TFMessage.idl:{headers}/msg/TFMessage.json"],
            "include_paths": [f"{name}:{PREFIX / 'share' / name}" for name in INTERFACES],
            "ros_interface_dependencies": [
                f"{name}:{idl}" for name in INTERFACES for idl in (PREFIX / "share" / name).glob("msg/*.idl")
            ],
            "ros_interface_files": [],
            "target_dependencies": [],
        }
        path = work / f"{generator}.json"
        path.write_text(json.dumps(values))
        return str(path)

    generate_type_hash(arguments("rosidl_generator_type_description", headers))
    found = json.loads((headers / "msg" / "TFMessage.json").read_text())["type_hashes"][0]["hash_string"]
    if found != TYPE_HASH:
        raise SystemExit(f"build_tf2_msgs: expected the type hash {TYPE_HASH}, got {found}")
    generate_c(arguments("rosidl_generator_c", headers))
    generate_typesupport_fastrtps_c(arguments("rosidl_typesupport_fastrtps_c", headers))
    generate_introspection(arguments("rosidl_typesupport_introspection_c", headers))
    generate_dispatch(arguments("rosidl_typesupport_c", headers), list(TYPE_SUPPORTS))
    generate_py(arguments("rosidl_generator_py", package), ["rosidl_typesupport_c"])
    (package / "__init__.py").touch()
    visible = "".join(
        f'#define {kind}_{word}_{PACKAGE} __attribute__((visibility("default")))\n'
        for kind in ("ROSIDL_GENERATOR_C", *(name.upper() for name in TYPE_SUPPORTS))
        for word in ("PUBLIC", "EXPORT", "IMPORT")
    )
    for kind in ("rosidl_generator_c", *TYPE_SUPPORTS):
        (headers / "msg" / f"{kind}__visibility_control.h").write_text(VISIBILITY + visible)


def build(work: Path, package: Path) -> None:
    """Compile what was generated: a library for each type support, and Python's extension, which needs both."""
    include = [work / "include", PREFIX / "include", *sorted((PREFIX / "include").iterdir())]
    include += [Path(sysconfig.get_path("include")), Path(np.get_include())]
    wheels = [
        *(f"{name}__rosidl_generator_c" for name in INTERFACES),
        *(f"geometry_msgs__{kind}" for kind in ("rosidl_generator_py", "rosidl_typesupport_c", *TYPE_SUPPORTS)),
        *("rosidl_runtime_c", "rosidl_typesupport_c", "rosidl_typesupport_fastrtps_cpp", "rcutils", "fastcdr"),
        *TYPE_SUPPORTS,
    ]

    def link(target: str, sources: list[Path], *ours: str) -> None:
        objects = []
        for source in sources:
            compiler = ["g++", "-std=c++17"] if source.suffix == ".cpp" else ["gcc", "-std=c11"]
            objects.append(str(work / f"{source.name}.o"))
            run([*compiler, "-O2", "-fPIC", "-c", str(source), "-o", objects[-1], *(f"-I{path}" for path in include)])
        where = ["-Wl,--no-as-needed", f"-L{package}", f"-L{PREFIX / 'lib'}", f"-Wl,-rpath,$ORIGIN:{PREFIX / 'lib'}"]
        libraries = [f"-l{name}" for name in (*ours, *wheels)]
        run(["g++", "-shared", "-o", str(package / target), f"-Wl,-soname,{target}", *objects, *where, *libraries])

    # The dispatching type support looks for the other two by their names, and finds them because they are loaded.
    made = work / "include" / PACKAGE / "msg"
    detail = made / "detail"
    fast, introspection = (f"{PACKAGE}__{name}" for name in TYPE_SUPPORTS)
    functions = [detail / f"tf_message__{name}" for name in ("functions.c", "description.c", "type_support_c.cpp")]
    link(f"lib{fast}.so", functions)
    link(f"lib{introspection}.so", [detail / "tf_message__type_support.c"], fast)
    python = [package / "msg" / "_tf_message_s.c", package / f"_{PACKAGE}_s.ep.rosidl_typesupport_c.c"]
    extension = f"{PACKAGE}_s__rosidl_typesupport_c{sysconfig.get_config_var('EXT_SUFFIX')}"
    link(extension, [made / "tf_message__type_support.cpp", *python], fast, introspection)


def run(command: list[str]) -> None:
    """Run a compiler; its own words and its end when it fails."""
    try:
        subprocess.run(command, check=True)
    except FileNotFoundError:
        raise SystemExit(f"build_tf2_msgs: {command[0]} is not there; `apt install g++`") from None
    except subprocess.CalledProcessError:
        raise SystemExit(f"build_tf2_msgs: {command[0]} failed; is python3-dev installed?") from None


#: What a node does with the message, in a process of its own.
TRIAL = """
from geometry_msgs.msg import TransformStamped
from rclpy.serialization import deserialize_message, serialize_message
from tf2_msgs.msg import TFMessage
sent = TFMessage(transforms=[TransformStamped(child_frame_id="camera")])
assert deserialize_message(serialize_message(sent), TFMessage) == sent
"""


def main() -> None:
    """Build, try, and only then install: half a package would be worse than none."""
    where = Path(sys.argv[1] if len(sys.argv) > 1 else sysconfig.get_path("purelib")).resolve()
    where.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f".{PACKAGE}_", dir=where) as folder:
        work, package = Path(folder) / "work", Path(folder) / PACKAGE
        generate(work, package)
        build(work, package)
        if subprocess.run([sys.executable, "-c", TRIAL], env={**os.environ, "PYTHONPATH": folder}).returncode:
            raise SystemExit("build_tf2_msgs: the message that was built does not work; nothing was installed")
        shutil.rmtree(where / PACKAGE, ignore_errors=True)
        package.rename(where / PACKAGE)
    print(f"{where / PACKAGE} is built")


if __name__ == "__main__":
    main()
