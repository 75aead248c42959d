"""Results: everything that reads finished runs, from their directories or from published files.

From the bottom up: `code` (policy code as data), `reading` (run directories as
plain records), `scoring`, `behaviour` and `statistics` (passes over the records), `studies` (all of them for a report),
`tables`, `figures`, `html`, and `report`, which writes a report's files. `verify`, `rescore`, `publish` and
`leaderboard` stand beside them, `cli` above. `notebook` is the entry point for notebooks. The package imports
`evopolicy_common` alone.
"""
