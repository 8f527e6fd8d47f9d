"""A benchmark of few-shot concepts: frozen suites, submissions of methods, their check, and a leaderboard."""
