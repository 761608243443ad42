"""Figures that walk through a simulated recording leave nothing in the map: their masks are heeded."""

from pathlib import Path

import numpy as np

from duagc.converters.simulate.team import simulate
from duagc.pipeline.config.frontend import FrontendConfig
from duagc.pipeline.frontend.stage import run_frontend
from duagc.pipeline.recording import Recording, open_rgbd, read_log
from tests.fixtures.mesh_scenes import folder_of


def test_what_moves_is_not_in_the_map(tmp_path: Path) -> None:
    folder = folder_of(tmp_path / "flat", "obj")
    out = tmp_path / "rec"
    simulate(out, scene=str(folder), robots=1, frames=8, size=(96, 72), movers=2, workers=1)
    sensor_log = Recording(out).log("alpha")
    with open_rgbd(sensor_log) as log:
        camera, frames = log.camera, list(log.frames())
    config = FrontendConfig()
    few = {"final_iterations": 5, "final_iterations_view": 0, "max_gaussians": 20_000}
    quick = config.mapping.model_copy(update=few)
    run_frontend(sensor_log, tmp_path / "frontend.mcap", config.model_copy(update={"mapping": quick}))
    messages = {record.topic: record.message() for record in read_log(tmp_path / "frontend.mcap")}
    centers = messages["/alpha/map"].gaussians.means
    first = frames[0]  # the map's frame is that of this camera
    assert first.mask is not None
    hidden = ~first.mask
    assert hidden.mean() > 0.02
    ahead = centers[:, 2] > 0.1
    pixels = np.rint(camera.project(centers[ahead])).astype(int)
    inside = ((pixels >= 0) & (pixels < (camera.width, camera.height))).all(axis=1)
    u, v = pixels[inside].T
    z = centers[ahead][inside, 2]
    near = hidden[v, u] & (np.abs(z - first.depth[v, u]) < 0.1)
    assert len(z) > 200
    assert near.sum() <= 0.005 * len(z)  # 20 % without masks
