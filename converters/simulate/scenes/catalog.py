"""The procedural scenes by name, and how robots move and measure in them."""

from collections.abc import Callable
from dataclasses import dataclass

from duagc.converters.simulate.scenes.buildings import corridor, office
from duagc.converters.simulate.scenes.outdoor import outdoor
from duagc.converters.simulate.scenes.room import room
from duagc.converters.simulate.scenes.scene import Scene
from duagc.pipeline.base.errors import DuagError


@dataclass(frozen=True)
class SceneSettings:
    """How robots move and measure in a scene.

    Attributes:
        texel_m: of the texture.
        step_m: translation of a robot per frame.
        depth_scale_m: meters per unit of depth images.
        sky: whether there is a sky above instead of a ceiling.
        solid: whether things are closed, so that only their fronts can be seen.
    """

    texel_m: float = 0.005
    step_m: float = 0.028
    depth_scale_m: float = 1 / 5000
    sky: bool = False
    solid: bool = True


MESHES = SceneSettings(solid=False)
SCENES: dict[str, tuple[Callable[[int], Scene], SceneSettings]] = {
    "room": (room, SceneSettings(texel_m=0.004, step_m=0.022)),
    "office": (office, SceneSettings()),
    "corridor": (corridor, SceneSettings()),
    "outdoor": (outdoor, SceneSettings(texel_m=0.01, step_m=0.06, depth_scale_m=1 / 1000, sky=True)),
}


def build(name: str, seed: int) -> Scene:
    """Build a scene by its name.

    Args:
        name: one of `SCENES`.
        seed: of layout and textures.

    Raises:
        DuagError: there is no scene of that name.
    """
    if name not in SCENES:
        raise DuagError(f"scene is {name!r}, expected one of {', '.join(SCENES)}")
    return SCENES[name][0](seed)
