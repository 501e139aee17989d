"""The services of docker/compose.yaml, to be run as processes where there is no container engine."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import yaml

from tests.support.places import ROOT

FILE = ROOT / "docker" / "compose.yaml"
VARIABLE = re.compile(r"\$\{(\w+):-([^}]*)\}")
IMAGE = {"packuv": ["packuv"]}
"""Entry points of images whose services name none, as docker/Dockerfile has it"""


def read() -> dict[str, Any]:
    """The file, each variable with its default."""
    text = VARIABLE.sub(lambda found: found[2], FILE.read_text())
    parsed: dict[str, Any] = yaml.safe_load(text)
    return parsed


@dataclass(frozen=True)
class Service:
    """What a container of a service would run."""

    command: list[str]
    environment: dict[str, str]
    health: list[str]

    def placed(self, places: Mapping[str, str]) -> Service:
        """With hosts, ports and folders of this machine in place of those in containers."""
        wanted = re.compile("|".join(re.escape(place) for place in sorted(places, key=len, reverse=True)))

        def here(text: str) -> str:
            return wanted.sub(lambda found: places[found[0]], text)

        environment = {name: here(value) for name, value in self.environment.items()}
        return Service([here(word) for word in self.command], environment, [here(word) for word in self.health])


def service(name: str) -> Service:
    """One of the file."""
    given = read()["services"][name]
    kind = given["image"].partition(":")[0]
    entry = given.get("entrypoint", IMAGE.get(kind, []))
    kind_of_test, *health = given["healthcheck"].get("test", ["CMD"])
    assert kind_of_test == "CMD", "a shell may be missing in an image"
    return Service([*entry, *given["command"]], dict(given.get("environment", {})), health)


def own_environment(path: list[str], **more: str) -> dict[str, str]:
    """Of a process that knows of its surroundings what a container does: where programs are."""
    kept = {name: os.environ[name] for name in ("LANG", "LC_ALL", "TMPDIR") if name in os.environ}
    return {**kept, "PATH": os.pathsep.join([*path, "/usr/local/bin", "/usr/bin", "/bin"]), **more}
