"""What a pipeline of some size takes, calculated from what its parts cost on one machine."""
