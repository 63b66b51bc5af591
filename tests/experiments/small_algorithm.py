"""An algorithm small enough to learn within a test's seconds."""

SMALL_ALGORITHM = (
    "algorithm.batch_size=8",
    "algorithm.hidden_size=32",
    "algorithm.min_size_to_sample=30",
    "algorithm.policy_push_interval=5",
    "algorithm.replay_capacity=500",
)
"""``section.key=value``"""
