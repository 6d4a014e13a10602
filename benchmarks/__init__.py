"""Questions about the filter, each a command that prints the tables it is answered by.

They run from the root of the repository as ``python -m benchmarks.NAME``, and are no part of the installed package.
``bad_input``, ``verdicts``, ``prefiltered_pairs``, ``score_calibration``, ``focal_error`` and ``detectors`` fill
``docs/trust.md``; ``fit_ablation`` tells what each step of the robust fit is worth; ``speed``, ``clean_matches``,
``cpp_speed``, ``profile_network`` and ``pipeline_cost`` measure time. ``study`` holds what several of them share,
``fill_docs`` puts tables into the pages.
"""
