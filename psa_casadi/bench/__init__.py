"""The benchmark tables behind every figure the project states; `psa bench` prints them."""
