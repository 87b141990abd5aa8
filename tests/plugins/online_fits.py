"""Fits of a running session, as the fit answers them and a search adds its targets."""


def quantity(value, std, flag=None):
    return {
        "value": value, "std": std, "flag": flag,
        "interval_95": [value - 1.96 * std, value + 1.96 * std],
    }  # fmt: skip


def online_fit(duration_s=8.0, width=1.0, *, search=True, third="not visible"):
    """A fit of the paper's antenna, with deviations `width` times as large; two modes are good."""
    targets = [
        {"name": "damping of mode 1", "quantity": "damping", "mode": 1, "value": 0.0091,
         "std": 1e-4 * width, "asked_std": 9.1e-5, "doubt": ""},
        {"name": "damping of mode 3", "quantity": "damping", "mode": 3, "value": None,
         "std": None, "asked_std": 1e-4, "doubt": "It is not part of what was found."},
    ]  # fmt: skip
    fit = {
        "id": 3, "tick": round(1000 * duration_s), "duration_s": duration_s, "whole": False,
        "took_s": 0.3, "problem": "", "doubt": None, "warnings": [], "type": "VI",
        "findings": ["A disturbance at 50 Hz was modelled."],
        "modes": [
            {"mode": 1, "shown": True, "frequency_hz": quantity(2.5697, 2e-4 * width),
             "damping_ratio": quantity(0.0091, 1e-4 * width)},
            {"mode": 2, "shown": True, "frequency_hz": quantity(16.011, 5e-4 * width),
             "damping_ratio": quantity(0.00416, 3e-5 * width)},
            {"mode": 3, "shown": third != "not visible",
             "frequency_hz": quantity(44.82, 0.01),
             "damping_ratio": quantity(0.0099, 2e-4, "It depends on the structure.")},
        ],
        "parameters": {"alpha": quantity(0.998, 0.005), "zeta": quantity(7.04e-5, 2e-6),
                       "tool_inertia_kg_m2": quantity(0.0, 6e-7)},
        "plant": {"beam": {}}, "covariance": {"names": [], "matrix": [[1.0]]},
        "noise": {"frequency_hz": [1.0], "nm2_per_hz": [1e-9]},
        "text": [f"{duration_s:5.1f} s 0.910 ± 0.010 %"],
    }  # fmt: skip
    return fit | ({"search": {"left_s": 12.0, "targets": targets}} if search else {})
