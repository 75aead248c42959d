"""How an agent worked: its edits, the structure of its policies, the feedback that it used."""
