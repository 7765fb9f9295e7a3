"""What several tests share: the oracle, the faces tested against it, random games, odd instances."""
