# What the accuracy dial promises and delivers: table, figures and plot. The brute-force columns are kept in RUN/reference.
RUN ?= runs/tradeoff
include $(dir $(lastword $(MAKEFILE_LIST)))common.mk
HERE := $(dir $(lastword $(MAKEFILE_LIST)))
MODEL ?= auto

all: $(RUN)/tradeoff.md
.PHONY: all FORCE

$(RUN)/tradeoff.md: FORCE
	python $(HERE)benchmarks/tradeoff.py --run $(RUN) --model $(MODEL)
