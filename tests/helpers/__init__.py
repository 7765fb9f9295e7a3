"""What several tests share: the oracle, the faces held against it, random games, odd instances."""
