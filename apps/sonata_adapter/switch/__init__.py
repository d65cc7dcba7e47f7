"""Counting in the switch: reading its cells and its reports."""
