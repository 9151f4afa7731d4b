"""Deployment targets: the block `targets` of a deploy.yaml."""

import re
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, model_validator

from lce_rig.rig.profile import OutputFormats
from lce_rig.rig.settings import RobotName, Settings, Text, problem

# Allowed ssh options: those that run a local program are excluded.
SshOption = Literal[
    "AddressFamily",
    "CertificateFile",
    "Compression",
    "ConnectTimeout",
    "GlobalKnownHostsFile",
    "HostKeyAlias",
    "HostName",
    "IdentitiesOnly",
    "IdentityAgent",
    "IdentityFile",
    "Port",
    "ProxyJump",
    "ServerAliveCountMax",
    "ServerAliveInterval",
    "StrictHostKeyChecking",
    "User",
    "UserKnownHostsFile",
]
# [user@]host:path, in scp's syntax, without characters of shells and options.
_HOST = r"(?:[A-Za-z0-9_][A-Za-z0-9_.-]*@)?(?:[A-Za-z0-9][A-Za-z0-9_.-]*|\[[0-9A-Fa-f:.%a-z]+\])"
_REMOTE = re.compile(rf"({_HOST}):(.*)", re.DOTALL)
_REMOTE_PATH = re.compile(r"(?:~/)?[A-Za-z0-9_./][A-Za-z0-9_./+@=-]*")
# ssh pastes some options into commands: a jump into its own, others into those of the user's ssh_config.
_SSH_VALUE = re.compile(r"[A-Za-z0-9_.~/:@+=,][A-Za-z0-9_.~/:@+=,-]*")
_JUMPS = re.compile(rf"{_HOST}(?::[0-9]+)?(?:,{_HOST}(?::[0-9]+)?)*")
ROBOT_FIELD = "{robot}"
"""Stands for the robot's name in `to`."""


class TargetSettings(Settings):
    """A place from which robot software reads a result.

    Attributes:
        to: a folder on this computer, or `user@host:path` by OpenSSH; robot software reads `to`/current/.
            {robot} in it stands for the robot's name.
        robot: the robot there; results of another one are refused.
        formats: export formats; None for the profile's `exports`, else the usual ones.
        run: a command to run there afterwards, by sh; $1 is the robot's name.
        run_timeout_s: time limit of that command.
        ssh: options of ssh_config for the connection, such as Port and IdentityFile.
        keep: number of releases kept, the current one included.
    """

    to: Text
    robot: RobotName | None = None
    formats: Annotated[OutputFormats, Field(min_length=1, max_length=64)] | None = None
    run: Text | None = None
    run_timeout_s: Annotated[float, Field(gt=0, le=3600)] = 60.0
    ssh: Annotated[dict[SshOption, Text | int], Field(max_length=32)] = Field(default_factory=dict)
    keep: Annotated[int, Field(ge=2, le=1000)] = 10

    @model_validator(mode="after")
    def _place_is_clear(self) -> "TargetSettings":
        to = self.to.replace(ROBOT_FIELD, "robot")
        remote = _REMOTE.fullmatch(to)
        if remote is not None and not _REMOTE_PATH.fullmatch(remote[2]):
            what = f"{remote[2]!r}: a path there has letters, digits and _ . / + @ = - only"
            raise problem(what, "to")
        if remote is None and "@" in (named := to.partition(":")[0]) and ":" in to and "/" not in named:
            raise problem(f"{self.to!r}: neither a folder nor user@host:path; ./NAME is a folder", "to")
        if not self.to or self.to.startswith("-") or "\0" in self.to:
            raise problem("no folder and no user@host:path", "to")
        if remote is None and self.ssh:
            raise problem("belongs to a target user@host:path", "ssh")
        for name, value in self.ssh.items():
            if not (_JUMPS if name == "ProxyJump" else _SSH_VALUE).fullmatch(str(value)):
                allowed = "names of hosts" if name == "ProxyJump" else "letters, digits and _.~/:@+=,-"
                raise problem(f"{value!r}: only {allowed} are allowed", f"ssh.{name}")
        return self

    def for_robot(self, robot: str) -> "TargetSettings":
        """Insert a robot's name for {robot}; results of other robots are then refused.

        Raises:
            ValueError: the robot's name is invalid.
        """
        values = {"to": self.to.replace(ROBOT_FIELD, robot), "robot": self.robot or robot}
        return TargetSettings.model_validate(self.model_dump() | values)

    @property
    def host(self) -> str | None:
        """[user@]host; None for a folder on this computer."""
        remote = _REMOTE.fullmatch(self.to)
        return None if remote is None else remote[1]

    @property
    def path(self) -> str:
        """Folder at the target; relative paths start at the user's home there."""
        remote = _REMOTE.fullmatch(self.to)
        return self.to if remote is None else remote[2].removeprefix("~/") or "."

    def located(self, folder: Path) -> "TargetSettings":
        """Make local paths absolute; relative ones start at the file's folder."""
        if _REMOTE.fullmatch(self.to.replace(ROBOT_FIELD, "robot")):
            return self
        return self.model_copy(update={"to": str((folder / Path(self.to).expanduser()).absolute())})
