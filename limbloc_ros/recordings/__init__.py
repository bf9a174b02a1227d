# SPDX-License-Identifier: Apache-2.0
"""What is on disk: bags, videos, benchmark cases, results, and the offline run over them."""
