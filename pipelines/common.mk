# Shared by all pipelines: one rule a stage, real prerequisites, nothing half-built.
SHELL := bash
.SHELLFLAGS := -eu -o pipefail -c
.DELETE_ON_ERROR:
.DEFAULT_GOAL := all

P := plenocli
RUN ?= runs/experiment
SIGN ?=
include $(dir $(lastword $(MAKEFILE_LIST)))names.mk

$(RUN):
	@mkdir -p $@
$(RUN)/%/:
	@mkdir -p $@
# else Make takes them for files of its own and tries to remove them at the end
.PRECIOUS: $(RUN)/%/

# what all files of the folder are, for plenocli verify; SIGN=key signs it
SEAL = $(P) seal $(RUN) $(SIGN:%=--sign %)
$(RUN)/SHA256SUMS:
	@$(SEAL)
