"""Other policies as networks: functions from an observation to logits, for ``dan_policy.make_actor``."""
