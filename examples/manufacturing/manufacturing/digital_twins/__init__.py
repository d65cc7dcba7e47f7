"""Digital Twins: the state of every printer and of the fleet, anomalies, and the maintenance that follows."""
