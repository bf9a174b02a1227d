# SPDX-License-Identifier: Apache-2.0
"""Pictures and the HTML page made from a run."""
