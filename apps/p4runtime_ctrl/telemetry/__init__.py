"""Demand of consumers as entries of a switch's classifier."""
