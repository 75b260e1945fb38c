"""Make scans with a known truth, process them, and compare the result with the truth.

    python examples/simulate_data_set.py

For data sets on disk use ``designgen make RECIPE -o FOLDER --count N --vary scan.sigma_mm=1,2``.
"""

from pathlib import Path

import designgen
import processor

RECIPE = Path(__file__).resolve().parents[1] / "fixtures/frame-of-four.toml"  # or a name of ``designgen list``
SHOWN = ("centre error, median", "radius error, median", "centres within their 95 % intervals")


def main() -> None:
    """Print the errors of the balls for two noise levels and two seeds."""
    for noise_mm in (0.3, 2.0):
        for seed in (1, 2):
            # The truth never reaches the processing: it is a record of its own, and ``check`` alone reads it.
            scene, truth = designgen.make(str(RECIPE), seed=seed, settings={"scanner.noise_mm": noise_mm})
            results = processor.run(scene, seed=seed)
            metrics = {metric.name: metric for metric in processor.check(results, truth)}
            shown = ", ".join(f"{name} {metrics[name].value:.3f} {metrics[name].unit}" for name in SHOWN)
            print(f"noise {noise_mm} mm, seed {seed}: {shown}")


if __name__ == "__main__":
    main()
