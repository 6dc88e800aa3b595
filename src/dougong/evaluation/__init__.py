"""Truth to measure against: scenes, metrics and studies."""
