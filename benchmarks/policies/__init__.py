"""Other policies as networks: observation -> logits, given to ``dan_policy.make_actor``."""
