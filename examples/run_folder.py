"""Process a scan folder and print the verdict.

    python examples/run_folder.py [FOLDER] [OUTPUT]

It does what ``processor run FOLDER -o OUTPUT`` does; without OUTPUT nothing is written.
"""

import sys
from pathlib import Path

import processor

FOLDER = Path(__file__).resolve().parents[1] / "fixtures/scan-folder"


def main(folder: Path = FOLDER, output: Path | None = None) -> None:
    """Print status and verdict of the run, of each step, and the checks that have a limit."""
    results = processor.run(folder, output=output)
    print(f"verdict: {results.verdict.value}")
    for name, step in results.steps.items():
        print(f"step {name}: {step.status}")
    for metric in results.checks:
        if metric.limit == metric.limit:  # NaN: for information
            print(f"check {metric.name}: {metric.value:g} {metric.unit}, {'passed' if metric.passed else 'MISSED'}")


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))
