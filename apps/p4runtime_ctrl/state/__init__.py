"""The desired state of a switch, and the updates that establish it."""
