"""DDPG with hindsight experience replay: the learner, its networks and its tasks."""
