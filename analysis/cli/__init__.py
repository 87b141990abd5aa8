"""Commands of `analyze` beside the analysis itself."""
