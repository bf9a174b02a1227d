# SPDX-License-Identifier: Apache-2.0
"""Run -> pictures and one page for people: the paper's results section made from a recording."""
