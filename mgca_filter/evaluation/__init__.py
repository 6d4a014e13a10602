"""The scoreboard: two-view pose from putative matches, the filter and its rivals on the same pairs.

``sources`` reads pairs with their pose and ``pairs`` draws from them; ``methods`` says what a method answers,
``selection``, ``estimators`` and ``baselines`` make the rivals, ``product`` the filter's own rows, ``registry`` gives
them names; ``predict`` runs methods over pairs, ``timing`` takes their times (``time_matching``: gives rivals ours) and
``store`` keeps what they gave; ``metrics`` and ``curves`` turn it into figures, ``summary`` collects them, ``report``,
``figures``, ``qualitative`` and ``paper`` show them.
``python -m mgca_filter.evaluation --help`` runs all of it, ``docs/evaluation.md`` says how it measures.
"""
