"""Ray casting of textured meshes: exact depth at the pixel centers, color averaged over the pixel.

Rays meet triangles in Embree (Open3D's `RaycastingScene`), in float32. Color is the mean of 2 x 2 rays per pixel (of
two where these have nearly the same color), each with a texture sample of its own (bilinear, between the two mip
levels around the distance of the samples on the surface). Means are taken of the stored values (sRGB), as a Gaussian
map blends them, and as in the procedural room.
Where no ray hits there is a hole of the scan: depth 0, black; or, in a scene with a sky, the sky: depth 0.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from duagc.converters.simulate.render.meshes import LEVELS, MeshScene
from duagc.converters.simulate.render.renderer import RenderedView
from duagc.pipeline.base.arrays import Array
from duagc.pipeline.base.open3d_import import import_open3d
from duagc.pipeline.geometry.camera import PinholeCamera

OFFSETS = ((-0.25, -0.25), (0.25, -0.25), (-0.25, 0.25), (0.25, 0.25))
UNEVEN_GRAY = 4.0  # of 255: where the first and the last of these differ less, the two others are left out
SAMPLE_SPACING_PX = 0.5
LEAST_COSINE = 0.1  # a texture seen at a more grazing angle is blurred no further


class Caster:
    """Rays through a scene and distances to it, on one thread: the same numbers whatever the machine does besides."""

    def __init__(self, scene: MeshScene) -> None:
        """Give the triangles to Embree, on one thread.

        Args:
            scene: the triangles that rays meet.
        """
        o3d = import_open3d()
        self.scene = scene
        self._tensor = o3d.core.Tensor.from_numpy
        self._embree = o3d.t.geometry.RaycastingScene(nthreads=1)
        self._embree.add_triangles(
            self._tensor(scene.vertices.astype(np.float32)), self._tensor(scene.triangles.astype(np.uint32))
        )

    def hits(self, origins: Array, directions: NDArray[np.floating]) -> dict[str, NDArray]:
        """Where rays first meet the scene.

        Args:
            origins: [n, 3] or [3], meters, world frame.
            directions: [n, 3], world frame, of any length.

        Returns:
            t [n], in lengths of the direction, inf = nothing; triangle [n]; weights [n, 2] of its second and third
            corner; normals [n, 3].
        """
        rays = np.empty((len(directions), 6), dtype=np.float32)
        rays[:, :3], rays[:, 3:] = origins, directions
        hit = self._embree.cast_rays(self._tensor(rays), nthreads=1)
        return {
            "t": hit["t_hit"].numpy(),
            "triangle": hit["primitive_ids"].numpy(),
            "weights": hit["primitive_uvs"].numpy(),
            "normals": hit["primitive_normals"].numpy(),
        }

    def blocked(self, start: Array, offset: Array) -> NDArray[np.bool_]:
        """Whether anything lies between points and points with an offset, [n].

        Args:
            start: [n, 3], meters, world frame.
            offset: [n, 3], meters, world frame.
        """
        rays = np.concatenate([start, offset], axis=1).astype(np.float32)
        hidden = self._embree.test_occlusions(self._tensor(rays), tnear=0.0, tfar=1.0, nthreads=1)
        return np.asarray(hidden.numpy(), dtype=np.bool_)

    def clearance(self, points: Array) -> Array:
        """Distance (m) of points to the nearest surface, [...].

        Args:
            points: [..., 3], meters, world frame.
        """
        flat = np.asarray(points).reshape(-1, 3).astype(np.float32)
        distance = self._embree.compute_distance(self._tensor(flat), nthreads=1).numpy()
        return distance.astype(np.float64).reshape(np.shape(points)[:-1])


class MeshRenderer:
    """Renders a scene of meshes with one camera."""

    def __init__(self, caster: Caster, camera: PinholeCamera, sky: bool = False) -> None:
        """Compute how many texels per meter each triangle has, by which mip levels are chosen.

        Args:
            caster: rays through the scene.
            camera: of the images.
            sky: whether rays that meet nothing see a sky; else they see black.
        """
        self.caster, self.scene, self.camera, self.sky = caster, caster.scene, camera, sky
        self._texel_density = _texel_density(self.scene)

    def depth(self, T_world_camera: ArrayLike) -> tuple[Array, NDArray[np.int64]]:
        """Depth (z, m, [h, w]; 0 = nothing) and triangle seen (-1 = nothing) at the pixel centers.

        Args:
            T_world_camera: camera pose, [4, 4].
        """
        T = np.asarray(T_world_camera, dtype=np.float64)
        hit = self.caster.hits(T[:3, 3], self._directions(T, 0.0, 0.0))
        seen = np.isfinite(hit["t"])
        depth = np.where(seen, hit["t"], 0.0).astype(np.float64)
        triangle = np.where(seen, hit["triangle"].astype(np.int64), -1)
        shape = (self.camera.height, self.camera.width)
        return depth.reshape(shape), triangle.reshape(shape)

    def render(self, T_world_camera: ArrayLike) -> RenderedView:
        """Color and depth from a camera pose.

        Args:
            T_world_camera: camera pose, [4, 4].
        """
        depth, triangle = self.depth(T_world_camera)
        T = np.asarray(T_world_camera, dtype=np.float64)
        directions = [self._directions(T, *offset) for offset in OFFSETS]
        _, colors = self.shade(T[:3, 3], np.concatenate(directions[::3]))
        one, other = colors.reshape(2, -1, 3)
        mean = 0.5 * (one + other)
        uneven = np.flatnonzero(np.abs(one - other).max(axis=1) > UNEVEN_GRAY)
        _, more = self.shade(T[:3, 3], np.concatenate([each[uneven] for each in directions[1:3]]))
        mean[uneven] = 0.5 * mean[uneven] + 0.25 * more.reshape(2, -1, 3).sum(axis=0)
        return RenderedView(
            np.clip(np.rint(mean), 0, 255).astype(np.uint8).reshape(*depth.shape, 3), depth, triangle
        )

    def shade(
        self, origins: Array, directions: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """What rays, half a pixel apart, meet: z [n], meters, inf = nothing; colors [n, 3], 0 to 255.

        Args:
            origins: [n, 3] or [3], meters, world frame.
            directions: [n, 3], world frame; z counts their lengths (a meter along the optical axis).
        """
        hit = self.caster.hits(origins, directions)
        t = hit["t"].copy()
        missed = np.flatnonzero(~np.isfinite(t))
        hit["t"][missed], hit["triangle"][missed] = 0.0, 0  # another color in the end
        index = hit["triangle"].view(np.int32)
        level = self._level(hit["t"], index, directions, hit["normals"])
        colors = self.scene.sample(index, hit["weights"], level)
        colors[missed] = sky_color(directions[missed]) if self.sky else 0.0
        return t, colors

    def _directions(self, T_world_camera: Array, du: float, dv: float) -> NDArray[np.float32]:
        """World directions [h * w, 3] of rays next to the pixel centers by (du, dv) px, one meter along z.

        Column by column: a product of matrices so narrow takes twenty times as long.
        """
        camera = self.camera
        x = (np.arange(camera.width) + du - camera.cx) / camera.fx
        y = ((np.arange(camera.height) + dv - camera.cy) / camera.fy)[:, None]
        directions = np.empty((camera.height, camera.width, 3), dtype=np.float32)
        for k, (a, b, c) in enumerate(T_world_camera[:3, :3]):
            directions[..., k] = x * a + (y * b + c)
        return directions.reshape(-1, 3)

    def _level(
        self,
        depth: NDArray[np.float32],
        triangle: NDArray[np.int32],
        directions: NDArray[np.float32],
        normals: NDArray[np.float32],
    ) -> NDArray[np.float32]:
        """Mip level [n] whose texels are as large as samples are apart on the surface (geometric mean)."""
        length = np.sqrt(np.einsum("ij,ij->i", directions, directions))
        cosine = np.abs(np.einsum("ij,ij->i", normals, directions)) / length
        focal = np.sqrt(self.camera.fx * self.camera.fy)
        apart_m = SAMPLE_SPACING_PX / focal * depth / np.sqrt(np.clip(cosine, LEAST_COSINE, 1.0))
        texels = np.maximum(apart_m * self._texel_density[triangle], 1.0)
        return np.minimum(np.log2(texels), LEVELS - 1).astype(np.float32)


def sky_color(directions: NDArray[np.floating]) -> NDArray[np.float32]:
    """Colors [n, 3], RGB, 0 to 255, of the sky: paler at the horizon, with a few clouds.

    Args:
        directions: [n, 3], world frame, of any length.
    """
    d = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    height = np.clip(d[:, 2], 0.0, 1.0)[:, None]
    blue = np.array((214, 224, 234)) * (1 - height) ** 2 + np.array((92, 144, 206)) * (1 - (1 - height) ** 2)
    x, y = d[:, 0] / (0.25 + height[:, 0]), d[:, 1] / (0.25 + height[:, 0])
    waves = sum(
        np.sin(2.1**k * (x + 0.6 * (-1) ** k * y) + 1.7 * k)
        * np.sin(2.1**k * (y - 0.4 * x) + 2.3 * k)
        / 1.5**k
        for k in range(1, 5)
    )
    cloud = np.clip(1.6 * waves - 0.35, 0, 1)[:, None]
    return np.asarray((1 - 0.75 * cloud) * blue + 0.75 * cloud * 246, dtype=np.float32)


def _texel_density(scene: MeshScene) -> NDArray[np.float32]:
    """Texels per meter on every triangle, [m]; 0 without texture or without area."""
    a, b, c = np.moveaxis(scene.texels.astype(np.float64), 1, 0)
    p, q = b - a, c - a
    texels2 = 0.5 * np.abs(p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0])
    areas = scene.areas()
    density = np.sqrt(np.divide(texels2, areas, out=np.zeros_like(areas), where=areas > 1e-12))
    return np.minimum(density, 1e6).astype(np.float32)
