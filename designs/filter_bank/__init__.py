"""Bank of filters for monotone balances."""
