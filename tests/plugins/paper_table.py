"""The paper's Table 3: mean parameters of its twelve models."""

import csv
from pathlib import Path

from rigd.beam import Damping


def table_3():
    """Damping by type and weighting, such as ``VI-omega``."""
    sets = {}
    with (Path(__file__).parents[1] / "data" / "paper_table3.csv").open(newline="") as file:
        for row in csv.DictReader(file):
            name = "lambda_" if row["parameter"] == "lambda" else row["parameter"]
            sets.setdefault(f"{row['type']}-{row['weighting']}", {})[name] = float(row["mean"])
    return {name: Damping(**values) for name, values in sets.items()}
