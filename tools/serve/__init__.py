"""`climategs serve`: a renderer for closed-loop simulators over gRPC (docs/simulator.md)."""
