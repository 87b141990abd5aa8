"""Motor, beam and delays in discrete time, exact for a torque that is constant between switches."""

from math import floor

import numpy as np
from numpy.typing import NDArray

from rigd.beam.realisation import Realisation, couple, propagator
from rigd.control._loop_model import LoopModel
from rigd.control._pid import ControlDesignError

RealArray = NDArray[np.float64]

MAX_DELAY_PERIODS = 50
"""Longest delay in the model in periods: every period of delay adds one state."""


class DiscretePlant:
    """State space of motor, beam and delays in discrete time: ``z[k+1] = a z[k] + b u[k]``.

    The state z contains the state of motor and beam, the last commands (newest first), and past
    readings that are delayed. No reading depends on the command u of its own tick.

    Parameters
    ----------
    model
        Motor, delays and rate.
    realisation
        State space of the beam, or None for the motor alone.

    Attributes
    ----------
    a, b
        State matrix, shape (n, n), and column of the command, shape (n,).
    angle, velocity, sensor_torque
        Rows that give angle, velocity and the sensor's torque at a tick from the state.
    measured_angle, measured_torque
        Rows that give the readings of angle and torque at a tick from the state.
    shaft_torque_column
        Effect on the next state of 1 N·m on the shaft for one period.
    """

    def __init__(self, model: LoopModel, realisation: Realisation | None) -> None:
        coupled_plant = couple(
            realisation,
            motor_inertia_kg_m2=model.motor_inertia_kg_m2,
            viscous_nm_s_per_rad=model.viscous_nm_s_per_rad,
            tool_inertia_kg_m2=0.0 if model.plant is None else model.plant.tool_inertia_kg_m2,
        )
        period_s = 1.0 / model.rate_hz
        whole_periods, period_fraction = _split_delay(
            model.actuation_delay_s, period_s, "actuation.delay_s"
        )
        angle_delay_parts = _split_delay(model.angle_delay_s, period_s, "encoder.delay_s")
        torque_delay_parts = _split_delay(model.torque_delay_s, period_s, "sensor.delay_s")
        n = coupled_plant.b.size
        command_count = whole_periods + 1
        delay_chain_lengths = [
            w + (1 if f > 0.0 else 0) for w, f in (angle_delay_parts, torque_delay_parts)
        ]
        state_size = n + command_count + sum(delay_chain_lengths)

        # Columns of the torque before and after the switch within a period. Without a whole period
        # of delay the command after it is the tick's own: the input column, last.
        column_before_switch = n + whole_periods
        column_after_switch = column_before_switch - 1 if whole_periods else state_size
        command_switch_s = period_fraction * period_s
        extended_matrix = np.zeros((state_size, state_size + 1))

        def state_map_after(duration_s: float) -> tuple[RealArray, int]:
            """Return the linear map to the state at a time after a tick, shape (n, state_size + 1).

            The second result is the column of the torque that acts at that time.
            """
            state_map, torque_column = np.eye(n, state_size + 1), column_before_switch
            for interval_s, acting_column in (
                (min(duration_s, command_switch_s), column_before_switch),
                (duration_s - command_switch_s, column_after_switch),
            ):
                if interval_s > 0.0:
                    transition, torque_effect = propagator(coupled_plant, interval_s)
                    state_map = transition @ state_map
                    state_map[:, acting_column] += torque_effect
                    torque_column = acting_column
            return state_map, torque_column

        def reading_row(
            quantity_row: RealArray, quantity_per_torque: float, time_since_tick_s: float = 0.0
        ) -> RealArray:
            """Return the row vector of a reading at a time after a tick, (state_size + 1,)."""
            state_map, torque_column = state_map_after(time_since_tick_s)
            effect_row: RealArray = quantity_row @ state_map
            effect_row[torque_column] += quantity_per_torque
            return effect_row

        extended_matrix[:n] = state_map_after(period_s)[0]
        self.shaft_torque_column = np.append(
            propagator(coupled_plant, period_s)[1], np.zeros(state_size - n)
        )
        extended_matrix[n, state_size] = 1.0
        for command_index in range(1, command_count):
            extended_matrix[n + command_index, n + command_index - 1] = 1.0

        angle_quantity = (coupled_plant.angle_output_row, 0.0)
        sensor_torque_quantity = (
            coupled_plant.sensor_torque_output_row,
            coupled_plant.sensor_torque_per_torque,
        )
        self.angle = reading_row(*angle_quantity)[:state_size]
        self.velocity = reading_row(coupled_plant.velocity_output_row, 0.0)[:state_size]
        self.sensor_torque = reading_row(*sensor_torque_quantity)[:state_size]

        measured_rows = []
        delay_chain_begin = n + command_count
        for (_, fraction), chain_length, reading_quantity, undelayed_row in (
            (angle_delay_parts, delay_chain_lengths[0], angle_quantity, self.angle),
            (
                torque_delay_parts,
                delay_chain_lengths[1],
                sensor_torque_quantity,
                self.sensor_torque,
            ),
        ):
            if chain_length == 0:
                measured_rows.append(undelayed_row)
                continue
            # The chain's first link: the reading of the last tick, or one from the period since.
            periods_since_tick = 1.0 - fraction if fraction > 0.0 else 0.0
            extended_matrix[delay_chain_begin] = reading_row(
                *reading_quantity, periods_since_tick * period_s
            )
            for chain_link in range(delay_chain_begin + 1, delay_chain_begin + chain_length):
                extended_matrix[chain_link, chain_link - 1] = 1.0
            measured_rows.append(np.eye(state_size)[delay_chain_begin + chain_length - 1])
            delay_chain_begin += chain_length
        self.measured_angle, self.measured_torque = measured_rows
        self.a = extended_matrix[:, :state_size]
        self.b = extended_matrix[:, state_size]


def _split_delay(delay_s: float, period_s: float, delay_key: str) -> tuple[int, float]:
    """Return the whole periods of a delay, and the remainder as a fraction of a period.

    `delay_key` is the delay's name in the message of the `ControlDesignError` for too long a delay.
    """
    delay_periods = delay_s / period_s
    if delay_periods > MAX_DELAY_PERIODS:
        raise ControlDesignError(
            f"{delay_key} = {delay_s:g} s is {delay_periods:.4g} periods; "
            f"at most {MAX_DELAY_PERIODS} can be controlled over."
        )
    whole_periods = floor(delay_periods + 1e-9)
    period_fraction = delay_periods - whole_periods
    return whole_periods, period_fraction if period_fraction > 1e-9 else 0.0
