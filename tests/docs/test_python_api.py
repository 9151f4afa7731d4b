"""The front door: light, complete, and documented."""

import subprocess
import sys
from pathlib import Path
from types import ModuleType

import lce_rig as lce

PAGE = Path(__file__).parents[2] / "docs" / "python-api.md"


def test_importing_it_imports_nothing_heavy():
    heavy = ("numpy", "cv2", "scipy", "open3d", "pydantic", "yaml", "click", "lce_rig.core")
    script = f"import sys, lce_rig; print([m for m in {heavy} if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_import_leaves_environment():
    script = "import os; before = dict(os.environ); import lce_rig.core.files; print(os.environ == before)"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "True"


def test_every_public_name_is_there_and_on_the_page():
    words = PAGE.read_text(encoding="utf-8")
    for name in lce.__all__:
        assert not isinstance(getattr(lce, name), ModuleType)
        assert f"`{name}`" in words or f"`{name}(" in words, name
        assert name in dir(lce)


def test_packages_and_functions_share_no_names():
    import lce_rig.detect.finder as finder
    import lce_rig.export as exports

    assert finder.BoardFinder and exports.write_exports is lce.write_exports
    packages = {path.parent.name for path in Path(lce.__file__).parent.glob("*/__init__.py")}
    assert not packages & set(lce.__all__)


def test_a_name_that_is_not_there_is_an_attribute_error():
    assert not hasattr(lce, "calibrat")
