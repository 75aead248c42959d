"""How sure the scores are: intervals, tests, tie groups, aggregates, and what a suite can resolve.

    from evopolicy_coordinator.analysis import study

    core16 = study(["runs"]).suites[0].statistics
    for pair in core16.pairs:                    # typed records
        print(pair.env, pair.first, pair.second, pair.gap, pair.p_holm, pair.verdict)

Pure: arrays in, records out, seeded. `samples` is the input; `intervals` and `permutation` hold the methods; `pairs`, `standings`,
`resolution`, `aggregates` and `generalisation` what a report tells; `suite` puts them together. Only runs that
the report compares come here, so runs that are no fair comparison mix only where the operator allowed it.
"""
