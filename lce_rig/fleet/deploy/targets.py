"""Find a target by its name: in a file, in the deploy.yaml beside a session, or in the session's profile."""

from pathlib import Path
from typing import Annotated, Any

from pydantic import ConfigDict, Field, ValidationError

from lce_rig.core.errors import UsageError
from lce_rig.rig import Rig
from lce_rig.rig.document import read_document
from lce_rig.rig.loading import explain, read_profile
from lce_rig.rig.settings import RobotName, Settings
from lce_rig.rig.target_settings import TargetSettings

TARGETS_FILE = "deploy.yaml"


class _TargetsFile(Settings):
    # A rig's profile can be given, too: only its targets are read.
    model_config = ConfigDict(extra="ignore")
    targets: Annotated[dict[RobotName, TargetSettings], Field(min_length=1)]


def read_targets(path: Path, robot: str = "") -> dict[str, TargetSettings]:
    """Read the block `targets` of a file; paths of this computer become absolute.

    Args:
        path: the file.
        robot: what `{robot}` stands for in it; "" leaves it as it is.

    Raises:
        ProfileError: no such file, or an invalid one; every problem with line and key.
    """
    text = read_profile(path)
    document = read_document(text.replace("{robot}", robot) if robot else text, str(path))
    try:
        found: Any = _TargetsFile.model_validate(document.data)
    except ValidationError as error:
        raise explain(error, document) from error
    return {name: target.located(path.parent) for name, target in found.targets.items()}


def find_target(
    name: str, file: Path | None, session: Path | None, rig: Rig | None, *, robot: str = ""
) -> TargetSettings:
    """Find a target: in the file if one is given, else beside the session, else in its profile.

    Args:
        name: of the target.
        file: that lists targets.
        session: its folder; deploy.yaml is looked for in its parent.
        rig: the session's profile.
        robot: what `{robot}` stands for in the file.

    Raises:
        ProfileError: a file is invalid.
        UsageError: there is no target of this name; the hint lists those that there are.
    """
    known: dict[str, TargetSettings] = {}
    beside = None if session is None else session.resolve().parent / TARGETS_FILE
    if file is not None:
        known = read_targets(file, robot)
    else:
        known |= {} if rig is None else rig.targets
        if beside is not None and beside.is_file():
            known |= read_targets(beside)
    if name in known:
        return known[name]
    where = file or beside or TARGETS_FILE
    hint = f"Known targets: {', '.join(known)}." if known else f"List targets in {where}, or in the profile."
    raise UsageError(f"no target is called {name!r}", hint)
