"""The agents that come with the project. All but `llm` need no language model; `evolve` is the reference agent."""
