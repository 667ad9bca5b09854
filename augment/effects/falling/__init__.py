"""Rain and snow that fall through the air."""
