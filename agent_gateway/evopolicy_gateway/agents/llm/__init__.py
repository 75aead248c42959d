"""The built-in LLM agent: a model with one tool, a shell in the workspace. It runs in the agent's jail.

It needs only an API key: pydantic-ai and the vendors' libraries speak to the provider. Its output has the form of
Claude Code's `stream-json`, which the harness, the live page, and the reports read already.
`harnesses/coding_agents/llm.py` starts it, once for each turn.

Only the standard library, pydantic-ai and the vendors' libraries are imported here, since the jail shows nothing
else.
"""
