"""The data of the rules: plain records, the tables of all that is open, the allowed transitions, and one step."""
