# SPDX-License-Identifier: Apache-2.0
"""Topics, their quality of service, and messages to arrays and back."""
