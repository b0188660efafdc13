# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Rotations between the links of a robot, from its URDF.

Links that fixed joints connect form one rigid body. Only within a body does a URDF state
how two units are mounted against each other.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple, NoReturn
from xml.etree.ElementTree import Element, TreeBuilder
from xml.parsers import expat

import numpy as np

from fdi_ros.bag.reader import Recording
from fdi_ros.core.messages import ENCAPSULATION, byte_order
from fdi_ros.errors import ConfigError
from fdi_ros.model.samples import Array
from fdi_ros.system.files import URDF_BYTES, open_regular
from fdi_ros.system.text import first_of, shown

#: links listed in an error
_MOST_LINKS = 20
_TEXT = "std_msgs/msg/String"


def read_urdf(source: Path, recording: Path) -> Urdf:
    """Return the URDF in a file, or in the topic of this name of a recording.

    `ConfigError` if there is neither, or it is no URDF.
    """
    try:
        with open_regular(source) as file:
            data = file.read(URDF_BYTES + 1)
    except FileNotFoundError as error:
        published = _first_text(recording, str(source))
        if published is None:
            raise ConfigError(
                f"no URDF: there is no file {shown(source)}, and {shown(recording.name)}"
                f" has no message on a topic of that name with the type {_TEXT}"
            ) from error
        return Urdf(str(source), published)
    except OSError as error:
        raise ConfigError(f"cannot read {source}: {error.strerror}") from error
    return Urdf(source.name, data)


def _first_text(path: Path, topic: str) -> bytes | None:
    """Return the first text on a topic of a recording, None if it has none."""
    with Recording(path) as recording:
        texts = {one.name for one in recording.topics if one.type == _TEXT}
        if not texts.intersection((topic, f"/{topic}")):
            return None
        batch = next(filter(len, recording.batches([topic])), None)
        message = b"" if batch is None else batch.message(0)
    begin = ENCAPSULATION + 4
    if len(message) < begin:
        return None
    (size,) = struct.unpack_from(f"{byte_order(message)}I", message, ENCAPSULATION)
    return message[begin : begin + size].rstrip(b"\0")


class _Joint(NamedTuple):
    """The joint above a link."""

    #: of the joint
    name: str
    #: ``type`` in the URDF, such as ``fixed``
    kind: str
    #: name of the link above
    parent: str
    #: v_parent = rotation v_child, (3, 3)
    rotation: Array


class _Place(NamedTuple):
    """Orientation of a link in its rigid body."""

    #: link of the body that is nearest to the root
    top: str
    #: v_top = rotation v_link, (3, 3)
    rotation: Array


class Urdf:
    """Links and joints of a URDF. `ConfigError` if the data are not one."""

    def __init__(self, name: str, data: bytes) -> None:
        #: file or topic, safe to print
        self.name = shown(name)
        robot = self._parsed(data)
        #: names in the order of the file
        self.links = dict.fromkeys(
            link.get("name", "") for link in robot.findall("link")
        )
        #: joint above each link, by link
        self._above: dict[str, _Joint] = {}
        for element in robot.findall("joint"):
            child, joint = self._joint(element)
            if child in self._above:
                self._refuse(f"link {shown(child)} has two joints above")
            self._above[child] = joint
        roots = [shown(link) for link in self.links if link not in self._above]
        if len(roots) != 1:
            self._refuse(
                f"links without a joint above: {first_of(roots, _MOST_LINKS) or 'none'}; must be one"
            )

    def mounts(self, frames: Sequence[str]) -> Array:
        """Return the mounts (n, 3, 3) of n links: v_first = mount v_link.

        The first link has the body frame. `ConfigError` if a link is missing, or
        moves against the first one.
        """
        places = [self._place(frame) for frame in frames]
        first = places[0]
        for frame, place in zip(frames, places, strict=True):
            if place.top != first.top:
                raise ConfigError(self._moving(frames[0], frame))
        rotations = [first.rotation.T @ place.rotation for place in places]
        # Cosines of right angles leave 1e-17, which no reader needs.
        return np.round(rotations, 12) + 0.0

    def _parsed(self, data: bytes) -> Element:
        """Return the element of the robot."""
        if len(data) > URDF_BYTES:
            self._refuse(f"more than {URDF_BYTES} bytes")
        builder = TreeBuilder()
        parser = expat.ParserCreate()
        parser.StartElementHandler = builder.start
        parser.EndElementHandler = builder.end
        # Entities need a document type, and a URDF has none.
        parser.StartDoctypeDeclHandler = self._refuse_doctype
        try:
            parser.Parse(data, True)
            robot = builder.close()
        except (expat.ExpatError, ValueError, LookupError) as error:
            self._refuse(shown(error))
        if robot.tag != "robot":
            self._refuse(f"its element is <{shown(robot.tag)}>, must be <robot>")
        if any(element.tag.startswith("xacro:") for element in robot):
            self._refuse("it has macros of xacro, which `xacro FILE` expands")
        return robot

    def _refuse_doctype(self, *_: object) -> None:
        self._refuse("document types and entities are refused")

    def _refuse(self, why: str) -> NoReturn:
        raise ConfigError(f"{self.name} is no URDF: {why}")

    def _joint(self, element: Element) -> tuple[str, _Joint]:
        """Return the link below a joint, and the joint."""
        name = shown(element.get("name"))
        ends = []
        for tag in ("child", "parent"):
            end = element.find(tag)
            link = None if end is None else end.get("link")
            if link not in self.links:
                self._refuse(f"the {tag} of joint {name} is {shown(link)}, not a link")
            ends.append(str(link))
        origin = element.find("origin")
        written = "0 0 0"
        if origin is not None:
            if origin.get("quat_xyzw") is not None:
                self._refuse(f"joint {name} has quat_xyzw, only rpy is read")
            written = origin.get("rpy", written)
        try:
            angles = [float(word) for word in written.split()]
        except ValueError:
            angles = []
        if len(angles) != 3 or not all(map(math.isfinite, angles)):
            self._refuse(f"rpy of joint {name} is {shown(written)}, not three numbers")
        child, parent = ends
        kind = shown(element.get("type"))
        return child, _Joint(name, kind, parent, _rotation(*angles))

    def _up(self, frame: str) -> list[str]:
        """Return the links from one to the root."""
        if frame not in self.links:
            raise ConfigError(
                f"{self.name} has no link {shown(frame)}, the frame of an IMU; {self._known}"
            )
        links = {frame: None}
        at = frame
        while at in self._above:
            at = self._above[at].parent
            if at in links:
                self._refuse(f"its joints form a circle at link {shown(at)}")
            links[at] = None
        return list(links)

    def _place(self, frame: str) -> _Place:
        """Return the orientation of a link in its body."""
        rotation = np.eye(3)
        for link in self._up(frame):
            joint = self._above.get(link)
            if joint is None or joint.kind != "fixed":
                return _Place(link, rotation)
            rotation = joint.rotation @ rotation
        raise AssertionError("the last link is the root")

    def _moving(self, first: str, frame: str) -> str:
        """Return words for a link that is in another body than the first one."""
        ways = self._up(frame), self._up(first)
        shared = set(ways[0]).intersection(ways[1])
        between = [link for way in ways for link in way if link not in shared]
        joints = [
            f"{joint.name} ({joint.kind})"
            for joint in map(self._above.__getitem__, between)
            if joint.kind != "fixed"
        ]
        return (
            f"{self.name}: link {shown(frame)} moves against {shown(first)} by"
            f" {first_of(joints, _MOST_LINKS)}; {self._known}"
        )

    @property
    def _known(self) -> str:
        links = [shown(link) for link in self.links]
        return f"its links: {first_of(links, _MOST_LINKS)}"


def _rotation(roll: float, pitch: float, yaw: float) -> Array:
    """Return the rotation (3, 3) of a URDF: about the fixed axes x, then y, then z, rad."""
    about_x = _about(0, roll)
    about_y = _about(1, pitch)
    return _about(2, yaw) @ about_y @ about_x


def _about(axis: int, angle: float) -> Array:
    """Return the rotation (3, 3) about a coordinate axis, rad."""
    rotation = np.eye(3)
    second = (axis + 1) % 3
    third = (axis + 2) % 3
    rotation[second, second] = rotation[third, third] = math.cos(angle)
    rotation[third, second] = math.sin(angle)
    rotation[second, third] = -math.sin(angle)
    return rotation
