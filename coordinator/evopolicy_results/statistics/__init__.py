"""The uncertainty of scores: intervals, tests, tie groups, aggregates, and the resolution of a suite.

    from evopolicy_results.notebook import study

    core16 = study(["runs"]).suites[0].statistics
    for pair in core16.pairs:                    # typed records
        print(pair.env, pair.first, pair.second, pair.gap, pair.p_holm, pair.verdict)

Pure: cells of `scoring` in, records out, seeded. Only runs that the report compares are used, so unfair mixtures occur
only if the operator allowed them.
"""
