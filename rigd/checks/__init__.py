"""``rigd check``: everything that can be known of a rig before a torque acts, in rows."""

from rigd.checks.rows import Row, Verdict, overall

__all__ = ["Row", "Verdict", "overall"]
