"""Let two robots map a simulated room, exchange over lossy links, and fuse their maps.

    python examples/04_two_robots.py [FOLDER]

FOLDER gets the recording and the run; without it both go to a temporary folder. Takes some seconds.
"""

import json
import sys
import tempfile
from pathlib import Path

import duagc


def main() -> None:
    """Simulate, run all stages, and print what the robots agreed on."""
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(temporary)
        duagc.simulate(folder / "recording", robots=2, frames=20, size=(160, 120))
        small = [
            "frontend.mapping.max_gaussians=3000",
            "frontend.mapping.final_iterations_view=4",
            "fusion.finetune.steps_per_view=4",
        ]  # quicker, less detail
        config = duagc.load_config(duagc.RunConfig, overrides=["exchange.link.loss_probability=0.2", *small])
        duagc.run(folder / "recording", folder / "run", config, until="evaluation")  # without report and view
        metrics = json.loads((folder / "run" / "metrics.json").read_text())
        for name, robot in duagc.RunFolder(folder / "run").robots.items():
            team = ", ".join(robot.component)
            print(
                f"{name}: team {team}; {len(robot.own_map.gaussians)} own Gaussians, "
                f"{len(robot.fused_map.gaussians)} after fusion"
            )
        print(f"ATE of the team: {1000 * metrics['team']['ate_rmse_m']:.2f} mm")
        print(
            f"sent: {metrics['exchange']['bytes_sent'] / 1e6:.2f} MB in {metrics['exchange']['rounds']} rounds"
        )
        print(f"digest of the run: {duagc.digest(folder / 'run')}")


if __name__ == "__main__":
    main()
