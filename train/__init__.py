"""Training of policies for the MinMax mTSP; run from a checkout as ``python -m train``."""
