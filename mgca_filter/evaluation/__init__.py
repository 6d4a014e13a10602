"""The scoreboard: two-view pose from putative matches, the filter and its rivals on the same pairs.

``pairs`` draws pairs from scene bundles, ``methods`` says what a method answers, ``baselines`` holds the rivals and
``product`` the filter itself, ``predict`` runs methods over pairs and ``store`` keeps what they gave, ``metrics``
turns errors into figures and ``report`` into tables. ``python -m mgca_filter.evaluation --help`` runs all of it.
"""
