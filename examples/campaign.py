"""Analyse several sessions of one specimen together.

Usage: python campaign.py SESSION.mcap SESSION.mcap ...
"""

import sys

from analysis import campaign


def main(paths: list[str]) -> None:
    """Print the estimate of each structure pooled over the sessions, and the verdict."""
    together = campaign(paths, types=["III", "VII"])
    for failure in together.failures:
        print(f"not used: {failure.path}: {failure.message}")
    print(f"{len(together.sessions)} sessions")
    for pooled in together.pooled:  # the lowest BIC first
        print(f"type {pooled.name}")
        for each in pooled.parameters:
            print(f"  {each.name} = {each.value:.4g} ± {each.std:.2g}")
        for mode in pooled.modes:
            print(f"  {mode.frequency_hz:.3f} Hz, damping ratio {100 * mode.damping_ratio:.3f} %")
    if together.verdict is not None:
        print(*together.verdict.sentences, sep="\n")


if __name__ == "__main__":  # worker processes import this file again
    main(sys.argv[1:])
