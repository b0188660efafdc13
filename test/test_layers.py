# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Imports follow the layers of docs/architecture.md, and each library has one place."""

import ast
import graphlib
import re
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest

from fdi_ros.system import REQUIREMENTS

PACKAGE = Path(__file__).parents[1] / "fdi_ros"
ARCHITECTURE = PACKAGE.parent / "docs" / "architecture.md"


def documented_layers():
    """Rows of the table in docs/architecture.md, top first: the parts that each holds."""
    section = ARCHITECTURE.read_text().partition("\n## Layers\n")[2]
    rows = section.partition("\n## ")[0].splitlines()
    cells = (row.split("|")[1] for row in rows if row.startswith("| `"))
    return [re.findall(r"`(\w+)(?:/|\.py)`", cell) for cell in cells]


LEVEL = {
    part: level for level, parts in enumerate(documented_layers()) for part in parts
}
BAG_LIBRARIES = {"rosbags", "mcap"}
MESSAGES = {
    f"{name}_msgs"
    for name in ("diagnostic", "geometry", "lifecycle", "rosgraph", "sensor", "std")
}
SERVICES = {"builtin_interfaces", "rcl_interfaces", "std_srvs"}
ROS = MESSAGES | SERVICES | {"rclpy", "ament_index_python", "launch", "launch_ros"}
ONLY_IN = {
    **dict.fromkeys(ROS, ("ros", "only ros does")),
    **dict.fromkeys(
        BAG_LIBRARIES,
        ("bag", "only bag opens bag files, and replay.outputs writes them"),
    ),
    **dict.fromkeys(
        ("pymavlink", "serial"), ("mavlink", "only mavlink talks to autopilots")
    ),
}
"""The only part that imports a library, in words."""
ASKED_FOR = {"monitor.output": ("pandas",)}
"""Libraries imported only where a user asks for what they make."""
NUMPY_ALONE = {
    "model",
    "compiling",
    "core",
    "estimator",
    "detectors",
    "monitor",
    "errors",
}


@cache
def imports(path):
    """Full names of all modules that a file imports, wherever it does."""
    found = []
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert not node.level, "imports are absolute"
            if node.module != "fdi_ros":
                found.append(str(node.module))
            found += [f"{node.module}.{alias.name}" for alias in node.names]
    return found


def violations(module, names):
    """What a module, named without the package, may not import of these."""
    part, found = module.partition(".")[0], []
    for name in names:
        package, _, rest = name.partition(".")
        target = rest.partition(".")[0]
        if package == "fdi_ros":
            if target in LEVEL and target != part and LEVEL[target] >= LEVEL[part]:
                found.append(f"{part} imports {name}, which is not in a row above it")
            if target not in LEVEL and target != "__version__" and part != "cli":
                found.append(f"{part} imports {name} through the package's own front")
        elif (
            package in ONLY_IN
            and part != ONLY_IN[package][0]
            and module != "replay.outputs"
        ):
            found.append(f"{module} imports {name}: {ONLY_IN[package][1]}")
        elif package in ("numba", "llvmlite"):
            if part != "compiling":
                found.append(
                    f"{module} imports {name}: only compiling knows the compiler"
                )
        elif (
            part in NUMPY_ALONE
            and package
            not in {"numpy", *ASKED_FOR.get(module, ())} | sys.stdlib_module_names
        ):
            found.append(f"{part} imports {name}: it needs NumPy alone")
    return sorted(set(found))


def modules():
    """Module names and files, the package's own front left out."""
    files = (path for path in PACKAGE.rglob("*.py") if path != PACKAGE / "__init__.py")
    return {
        ".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts): path
        for path in files
    }


def test_imports_follow_the_table_of_layers():
    known = modules()
    assert {module.split(".")[1] for module in known} - LEVEL.keys() == set(), (
        "they have no row in the table of docs/architecture.md"
    )
    found = {
        module: violations(module.partition(".")[2], imports(path))
        for module, path in known.items()
    }
    assert {module: told for module, told in found.items() if told} == {}


def test_no_import_goes_in_a_circle():
    known = modules()

    def there(name):
        return next((one for one in (name, f"{name}.__init__") if one in known), None)

    graph = {
        module: {there(name) for name in imports(path)} - {None, module}
        for module, path in known.items()
    }
    graphlib.TopologicalSorter(graph).prepare()
    folders = {}
    for module, targets in graph.items():
        names = {target.split(".")[1] for target in targets}
        part = module.split(".")[1]
        folders.setdefault(part, set()).update(names - {part})
    graphlib.TopologicalSorter(folders).prepare()


def python(code, *words):
    """What a fresh interpreter says, in which nothing loaded before hides a missing library."""
    command = [sys.executable, "-c", code, *map(str, words)]
    return subprocess.run(
        command,
        cwd=PACKAGE.parent,
        capture_output=True,
        text=True,
        timeout=400,
        check=False,
    )


def names_after(code):
    """What it prints last."""
    return set(ast.literal_eval(python(code).stdout.strip().splitlines()[-1]))


def test_the_core_imports_without_ros_and_bag_libraries():
    """And only what is used."""
    loaded = names_after(
        "import sys, fdi_ros; dir(fdi_ros); assert 'numpy' not in sys.modules;"
        "fdi_ros.Pipeline; print(sorted({name.split('.')[0] for name in sys.modules}))"
    )
    assert "numpy" in loaded
    # Numba looks which SciPy there is; of SciPy itself nothing is used here, which the imports above show.
    assert loaded.isdisjoint(ROS | BAG_LIBRARIES)


OFFLINE = {"bag", "inspection", "replay", "experiments", "report", "setup"}


def test_a_live_node_imports_nothing_that_is_for_offline_use():
    """All that it has imported when it has been configured and activated."""
    pytest.importorskip("rclpy", reason="the node needs ROS 2")
    code = """
import sys
before = set(sys.modules)
from fdi_ros.ros import process
def live(node, stop):
    node.create_timer(0.01, lambda: setattr(stop, "asked", True))
    type(node).live(node, stop)
def make():
    node = process._make("fdi_node")
    node.live = lambda stop: live(node, stop)
    return node
assert process.run("fdi_node", [], make) == 0
print([name for name in set(sys.modules) - before if sys.modules[name] is not None])
"""
    loaded = names_after(code)
    parts = {name.split(".")[1] for name in loaded if name.startswith("fdi_ros.")}
    assert "monitor" in parts
    assert parts.isdisjoint(OFFLINE)
    # Neither does Numba load its part of SciPy.
    assert {name.partition(".")[0] for name in loaded}.isdisjoint(
        {*REQUIREMENTS, "scipy", "rich", "pyarrow", "pymavlink"}
    )
