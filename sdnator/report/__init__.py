"""Report of a replay: page, plots and machine-readable files."""
