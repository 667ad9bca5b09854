"""drivestudio runs as scenes."""
