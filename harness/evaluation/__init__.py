"""What a trained agent can do: `levels` judges CoinRun's agents, `control` all others."""
