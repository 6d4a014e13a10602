"""The scoreboard: two-view pose from putative matches, the filter and its baselines on the same pairs.

``pairs`` draws from what :mod:`mgca_filter.data` reads; ``methods`` says what a method answers, ``selection`` and
``baselines`` make the baselines, ``our_rows`` the filter's own rows, ``registry`` gives them names; ``predict`` runs
methods over pairs, ``timing`` takes their times and ``store`` keeps what they gave; ``metrics`` and ``difficulty`` turn
it into figures, ``summarize`` collects them into a ``summary``, ``report``, ``figures`` and ``paper`` show it.
``python -m mgca_filter.evaluation --help`` runs all of it, ``docs/evaluation.md`` says how it measures.
"""
