"""Names of components: the parts of a robot's path that did not join each other.

The largest component of a robot has the robot's name; every other one has the number of its first submap as well, as in
"alpha-2". From the information stage on, a component takes part like a robot.
"""

from __future__ import annotations

import re

_NAME = re.compile(r"(?P<robot>.+)-(?P<number>[1-9][0-9]*)")


def component_name(robot: str, submap: int) -> str:
    """The name of a component that did not join the largest one of its robot.

    Args:
        robot: whose it is.
        submap: number of its first submap.
    """
    return f"{robot}-{submap}"


def submap_of(name: str) -> int | None:
    """The number in the name of a component; None in that of a robot.

    Args:
        name: of the component.
    """
    match = _NAME.fullmatch(name)
    return int(match["number"]) if match else None


def robot_of(name: str) -> str:
    """The robot of a component: the one whose sensor log it is made from.

    Args:
        name: of the component.
    """
    match = _NAME.fullmatch(name)
    return match["robot"] if match else name


def same_robot(one: str, other: str) -> bool:
    """Whether two components are of one robot.

    Args:
        one: name of a component.
        other: name of another.
    """
    return robot_of(one) == robot_of(other)
