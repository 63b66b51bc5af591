"""How often the initial policy reaches the goal, how fast anybody could, and what follows for the time limit."""
