"""The contract for people and other tools: tables, JSON Schema, AsyncAPI."""
