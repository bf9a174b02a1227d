# SPDX-License-Identifier: Apache-2.0
"""Bad input in bulk: `make fuzz` tries 100,000 damaged inputs a target, `test/test_fuzz.py` those that once failed."""
