"""Fit damping structures to a whole record, and select the one that the data support.

Usage: python fit_and_select.py SESSION.mcap
"""

import sys

from analysis import fit, load, select


def main(path: str) -> None:
    """Print the fits of two structures, then the results of the structure selection."""
    record = load(path)
    for found in fit(record, ["III", "VI"]).fits:
        print(f"type {found.structure.name}, cost {found.cost:.1f}")
        for name, value in found.parameters.items():
            low, high = found.interval.get(name, (value, value))
            print(f"  {name} = {value:.4g}, 95 % interval {low:.4g} to {high:.4g}")

    selection = select(record)
    print(*selection.verdict.sentences, sep="\n")
    for mode in selection.headline.modes:
        print(f"mode {mode.number}: {mode.frequency_hz.value:.3f} Hz")
    for name, quantity in selection.headline.parameters.items():
        # A flag states why a number is not a property of the antenna.
        print(f"{name} = {quantity.value:.4g} {quantity.flag or ''}")
    print("Next experiments:", *selection.verdict.experiments, sep="\n")


if __name__ == "__main__":
    main(sys.argv[1])
