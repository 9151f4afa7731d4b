"""Find a target by its name: in a file, in the deploy.yaml beside a session, or in the session's profile."""

from pathlib import Path
from typing import Annotated

from pydantic import ConfigDict, Field, ValidationError

from lce_rig.core.errors import UsageError
from lce_rig.rig import Rig
from lce_rig.rig.loading import explain, read_document, read_profile
from lce_rig.rig.settings import RobotName, Settings
from lce_rig.rig.target_settings import ROBOT_FIELD, TargetSettings

TARGETS_FILE = "deploy.yaml"


class _TargetsFile(Settings):
    # A rig's profile can be given, too: only its targets are read.
    model_config = ConfigDict(extra="ignore")
    targets: Annotated[dict[RobotName, TargetSettings], Field(min_length=1)]


def read_targets(path: Path) -> dict[str, TargetSettings]:
    """Read the block `targets` of a file; paths of this computer become absolute.

    Raises:
        ProfileError: no such file, or an invalid one; every problem with line and key.
    """
    document = read_document(read_profile(path), str(path))
    try:
        content = _TargetsFile.model_validate(document.data)
    except ValidationError as error:
        raise explain(error, document) from error
    return {name: target.located(path.parent) for name, target in content.targets.items()}


def find_target(name: str, file: Path | None, session: Path | None, rig: Rig | None) -> TargetSettings:
    """Find a target: in the file if one is given, else beside the session, else in its profile.

    Args:
        name: of the target.
        file: that lists targets.
        session: its folder; deploy.yaml is looked for in its parent.
        rig: the session's profile.

    Raises:
        ProfileError: a file is invalid.
        UsageError: there is no target of this name, or it stands for many robots.
    """
    targets: dict[str, TargetSettings] = {}
    beside = None if session is None else session.resolve().parent / TARGETS_FILE
    if file is not None:
        targets = read_targets(file)
    else:
        targets |= {} if rig is None else rig.targets
        if beside is not None and beside.is_file():
            targets |= read_targets(beside)
    target = targets.get(name)
    if target is not None and ROBOT_FIELD in target.to:
        if not target.robot:
            raise UsageError(
                f"target {name!r} stands for many robots",
                f"Use `lce-rig fleet deploy --registry FOLDER --target {name}`.",
            )
        return target.for_robot(target.robot)
    if target is not None:
        return target
    where = file or beside or TARGETS_FILE
    hint = (
        f"Known targets: {', '.join(targets)}." if targets else f"List targets in {where}, or in the profile."
    )
    raise UsageError(f"no target is called {name!r}", hint)
