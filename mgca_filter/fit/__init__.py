"""From scored matches to a judged two-view model."""
