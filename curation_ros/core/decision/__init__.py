"""From evidence to a decision: rules, verdicts, spans and selections."""
