# SPDX-License-Identifier: Apache-2.0
"""Every method that finds a placement, behind one interface."""
