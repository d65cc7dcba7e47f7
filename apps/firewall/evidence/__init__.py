"""Evidence about a sender: archived history and recent traffic."""
