"""Sound input for every reader: the fixtures of the other tests, as small as their checks allow.

In a small file, damage hits what is read more often, and a case takes less time.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Callable
from functools import cache
from pathlib import Path
from types import CodeType

import cv2
from rosbags.highlevel import anyreader
from rosbags.serde import utils as serde_utils
from rosbags.typesys import store

from duagc.converters.datasets import bonn, icl_nuim, seven_scenes, tum
from duagc.converters.layouts.ros_images import rows_of
from duagc.pipeline.geometry.camera import PinholeCamera
from tests.fixtures import (
    box_room,
    fake_run,
    foreign_mcap,
    image_folders,
    kimera_multi,
    lidar_logs,
    mesh_scenes,
    ros_bags,
)
from tests.fixtures import s3e as s3e_bags
from tests.fixtures import seven_scenes as seven_scenes_files
from tests.fixtures.mesh_scenes import QUADS
from tests.fixtures.recording_logs import write_recording
from tests.fixtures.ros_bags import Ros, scene
from tests.fixtures.rvl_images import rvl

SMALL_PX = 112  # wide: the self-check of converters wants 200 points, 6 pixels apart
STEREO_PX = 224  # that of rectification wants 50 features
FRAMES = 2


def small(camera: PinholeCamera, width: int = SMALL_PX) -> PinholeCamera:
    """The same view in few pixels."""
    return camera.scaled(width, round(camera.height * width / camera.width))


def shrink() -> None:
    """Make the cameras of datasets and of their fixtures small, for good: call this in a process that does no more."""
    for module in (bonn, icl_nuim):
        module.CAMERA = small(module.CAMERA)
    tum.CAMERAS = {name: (small(camera), lens) for name, (camera, lens) in tum.CAMERAS.items()}
    for fixtures, names in (
        (image_folders, ("SMALL", "ARIA", "DEPTH_CAMERA", "COLOR_CAMERA")),
        (ros_bags, ("COLOR", "DEPTH")),
        (kimera_multi, ("COLOR", "INFRA")),
    ):
        for name in names:
            setattr(fixtures, name, small(getattr(fixtures, name)))
    s3e_bags.LEFT = small(s3e_bags.LEFT, STEREO_PX)
    s3e_bags.RIGHTS = {name: small(camera, STEREO_PX) for name, camera in s3e_bags.RIGHTS.items()}
    for fixtures in (ros_bags, kimera_multi, s3e_bags, seven_scenes_files):
        fixtures.FRAMES = FRAMES
    seven_scenes.WIDTH, seven_scenes.HEIGHT = SMALL_PX, round(SMALL_PX * 0.75)
    wall = fake_run.wall
    fake_run.wall = lambda seed=0: wall(seed).select(slice(None, None, 50))
    mesh_scenes.TEXEL_M = 0.1
    # most of the time to read a bag goes into texts that every bag holds, and into code that is made of them
    anyreader.get_types_from_msg = cache(anyreader.get_types_from_msg)
    store.exec = serde_utils.exec = lambda text, *where: exec(_compiled(text), *where)


@cache
def _compiled(text: str) -> CodeType:
    return compile(text, "made by rosbags", "exec")


def image_options(dataset: str) -> list[str]:
    """Options of the datasets that are folders of images."""
    cameras = {"replica-multiagent": image_folders.SMALL, "aria-multiagent": image_folders.ARIA}
    camera = cameras.get(dataset)
    return [f"size={camera.width}x{camera.height}"] if camera else []


def ros_bag(version: int, container: str) -> Callable[[Path], Path]:
    def make(root: Path) -> Path:
        root.mkdir(parents=True)
        r = Ros(version)
        return r.write(root / "bag", scene(r), container)

    return make


def compressed_bag(root: Path) -> Path:
    """Color as JPEG, depth as PNG and RVL in turns, with the headers that `image_transport` writes."""
    root.mkdir(parents=True)
    r = Ros(2)
    rows = []
    for topic, at, message in scene(r):
        if topic.endswith("image_raw"):
            pixels = rows_of(message, "", "uint8", 3)
            data = cv2.imencode(".jpg", pixels[..., ::-1])[1].tobytes()
            topic, text = f"{topic}/compressed", "rgb8; jpeg compressed bgr8"
        elif topic.endswith("image_rect_raw"):
            raw = rows_of(message, "", "uint16", 1)[..., 0]
            packing = ("png", "rvl")[len(rows) // 3 % 2]
            packed = rvl(raw) if packing == "rvl" else cv2.imencode(".png", raw)[1].tobytes()
            data = struct.pack("<iff", 0, 0.0, 0.0) + packed
            topic, text = f"{topic}/compressedDepth", f"16UC1; compressedDepth {packing}"
        else:
            rows.append((topic, at, message))
            continue
        stamp = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
        rows.append((topic, at, r.compressed(stamp, message.header.frame_id, data, text)))
    return r.write(root / "bag", rows, "sqlite3")


def lidar_bag(root: Path) -> Path:
    """A camera, a LiDAR and an IMU."""
    root.mkdir(parents=True)
    return lidar_logs.lidar_log(root)


LIDAR_OPTIONS = ("depth_from=lidar", "truth=/odom", "imu=/imu")


def team_file(root: Path) -> Path:
    """A TOML file about two robots, their bags, and true poses in a file."""
    root.mkdir(parents=True)
    r = Ros(2)
    lines = []
    for name in ("a", "b"):
        rows = scene(r, f"/{name}")
        r.write(root / name, rows, "mcap")
        lines += [f"[robots.{name}]", f'logs = ["{name}"]', f'namespace = "/{name}"', 'truth_file = "gt.tum"']
        lines += ["truth_offset_s = 0.25", 'T_truth_color = "0 0 0 1 0 0 0"', ""]
    poses = [
        image_folders.tum_line((ros_bags.START_NS + (i + 1) * ros_bags.STEP_NS) / 1e9 - 0.25, T)
        for i, T in enumerate(box_room.path(FRAMES))
    ]
    (root / "gt.tum").write_text("\n".join(poses) + "\n")
    (root / "team.toml").write_text("\n".join(lines))
    return root / "team.toml"


def make_logs(seed: Path) -> None:
    """Logs of other programs, one of each kind."""
    foreign("json")(seed / "logs" / "json")
    foreign("ros1")(seed / "logs" / "ros1")
    ros_bag(2, "sqlite3")(seed / "logs" / "ros2")


def foreign(kind: str) -> Callable[[Path], Path]:
    def make(root: Path) -> Path:
        r = Ros(1 if kind == "ros1" else 2)
        return foreign_mcap.write(root / "log.mcap", scene(r), kind, r)

    return make


def kimera(root: Path) -> Path:
    folder = root / "campus_outdoor_1014_compressed"
    folder.mkdir(parents=True)
    r = Ros(1)
    rows = kimera_multi.bag_rows(r, "sparkal2", 0.3, "sparkal2")
    r.write(folder / "10_14_sparkal2", rows, "lz4")
    kimera_multi.write_truth(root / "ground_truth" / "1014" / "sparkal2_gt_odom.csv", 0.3)
    return folder


def s3e(root: Path) -> Path:
    sequence = root / "S3E_Playground_2"
    names = s3e_bags.NAMES[:2]
    s3e_bags.write_bag(sequence, names)
    for name in names:
        s3e_bags.write_calibration(root / "Calibration" / f"{name.lower()}.yaml", name.lower())
        s3e_bags.write_truth(sequence / f"{name.lower()}_gt.txt", name)
    return sequence


def seven(root: Path) -> Path:
    """One sequence."""
    return seven_scenes_files.make_sequence(root / "seq-01")


def seven_options() -> list[str]:
    """The cameras of 7-Scenes in few pixels."""
    shrunk = SMALL_PX / 640
    names = ("depth_focal_px", "depth_cx_px", "depth_cy_px", "color_focal_px", "color_cx_px", "color_cy_px")
    return [f"{name}={shrunk * getattr(seven_scenes.Options(), name)!r}" for name in names]


def make_recording(seed: Path) -> None:
    write_recording(seed / "rec", robots=2, frames=3)


def make_scene(kind: str) -> Callable[[Path], None]:
    def make(seed: Path) -> None:
        (seed / "scene").mkdir()
        for name, sides in (("walls", QUADS[9:11]), ("table", QUADS[11:])):
            mesh_scenes.WRITERS[kind](seed / "scene" / f"{name}.{kind}", sides)

    return make


def make_gltf(seed: Path) -> None:
    """A glTF file with its arrays in another file, and its images in files of their own."""
    make_scene("glb")(seed)
    (seed / "scene" / "table.glb").unlink()
    glb = seed / "scene" / "walls.glb"
    data = glb.read_bytes()
    glb.unlink()
    (size,) = struct.unpack_from("<I", data, 12)
    content, blob = json.loads(data[20 : 20 + size]), data[28 + size :]
    for k, image in enumerate(content["images"]):
        view = content["bufferViews"][image.pop("bufferView")]
        image["uri"] = f"image{k}.png"
        start = view["byteOffset"]
        (seed / "scene" / image["uri"]).write_bytes(blob[start : start + view["byteLength"]])
    content["buffers"][0]["uri"] = "table.bin"
    (seed / "scene" / "table.bin").write_bytes(blob)
    (seed / "scene" / "table.gltf").write_text(json.dumps(content))


CSV_COLUMNS = "robot_src,pose_src,robot_dst,pose_dst,qx,qy,qz,qw,tx,ty,tz,kappa,tau"


def make_g2o(seed: Path) -> None:
    from tests.fixtures.pose_graphs import helix_edges, write_g2o

    write_g2o(seed / "graph.g2o", helix_edges(24))


def make_csv(seed: Path) -> None:
    rows = [f"{r},{i},{r},{i + 1},0,0,0,1,0.{i},0.1,0,100,10000" for r in (0, 1) for i in range(9)]
    rows.append("0,2,1,3,0,0,0,1,0,1,0,100,10000")
    for robot in (0, 1):
        own = [row for row in rows if row.startswith(f"{robot},")]
        (seed / f"robot{robot}").mkdir()
        (seed / f"robot{robot}" / "measurements.csv").write_text("\n".join([CSV_COLUMNS, *own, ""]))


def make_config(seed: Path) -> None:
    from duagc.pipeline.config.base import dump_config
    from duagc.pipeline.config.run import RunConfig

    (seed / "config.toml").write_text(dump_config(RunConfig()))


def make_gaussians(seed: Path) -> None:
    from duagc.pipeline.splat.ply import write_ply

    write_ply(seed / "map.ply", fake_run.wall().select(slice(40)))


def make_run(seed: Path) -> None:
    fake_run._write_recording = lambda *arguments: None  # is not read
    fake_run.make(seed)


def make_trajectory(seed: Path) -> None:
    lines = [f"{1305031452 + 0.1 * i:.4f} {0.1 * i} 1.5 -0.2 0 0 0.6 0.8" for i in range(20)]
    (seed / "poses.tum").write_text("\n".join(["# stamp x y z qx qy qz qw", *lines]))
