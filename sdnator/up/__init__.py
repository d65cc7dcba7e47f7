"""The pipeline of `sdnator up`: its plan, its parts, and the run file by which commands find it."""
