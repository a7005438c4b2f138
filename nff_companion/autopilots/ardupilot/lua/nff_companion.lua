-- The autopilot's side of nff-companion: takes motor declarations, allocation matrices and motor outputs through TUNNEL.
--
-- What is in force, the first that holds: overrides of single channels (they expire in the firmware by themselves);
-- the streamed matrix while it is fresh; the stored table of the declared motors; the stock factors.
-- A declaration is held when the link is lost; everything else is given up. Nothing is driven when disarmed.

local P = require("nff_protocol")
local T = require("nff_times") -- written by `nff ardupilot install`, as nff_airframe is
local airframe = require("nff_airframe") -- motors, tables, pwm range
local mixer = require("nff_mixer")
local commands = require("nff_commands")

local SOURCE_STOCK, SOURCE_DECLARATION, SOURCE_MATRIX, SOURCE_OVERRIDE = 0, 1, 2, 3
local TEXT_WARNING, TEXT_INFO = 4, 6
local PARAMETER_TABLE = 146 -- key of our parameters: one number a script, for all scripts of a vehicle

local motors = airframe.motors
local boot_ms = millis():toint()
local last_applied_ms = 0
local applied_sequence = 0
local errors = 0
local watchdog_count, watchdog_seen_ms = -1, boot_ms - T.WATCHDOG_SILENT_MS
local ticks = 0
local last_run_ms = boot_ms

-- Counters that the watchdog script and a ground station can read; and the frame that was flown before our mixer, by
-- which the companion compares its airframe file.
param:add_table(PARAMETER_TABLE, "NFF_", 4)
param:add_param(PARAMETER_TABLE, 1, "ALIVE", 0)
param:add_param(PARAMETER_TABLE, 2, "FAILED", 0)
param:add_param(PARAMETER_TABLE, 3, "WATCH", 0)
param:add_param(PARAMETER_TABLE, 4, "FRAME", 0)
Parameter("NFF_FRAME"):set(airframe.frame)
local alive = Parameter("NFF_ALIVE")
local watchdog = Parameter("NFF_WATCH")
commands.failed_parameter = Parameter("NFF_FAILED")
commands.set_held(0)

-- Puts in force what the top of this file says.
local function apply()
  local matrix = commands.matrix
  mixer.apply(commands.held, matrix and matrix.factors)
end

local function source(now)
  if now < commands.override_until_ms then
    return SOURCE_OVERRIDE
  end
  if commands.matrix then
    return SOURCE_MATRIX
  end
  return commands.held ~= 0 and SOURCE_DECLARATION or SOURCE_STOCK
end

local function flags(now, complete)
  return (arming:is_armed() and 1 or 0)
    | (mixer.dynamic and 2 or 0)
    | (now - watchdog_seen_ms < T.WATCHDOG_SILENT_MS and 4 or 0)
    | (commands.linked(now) and 8 or 0)
    | (commands.matrix and commands.matrix.released and 16 or 0)
    | (complete and 32 or 0)
end

local function say(to, data)
  mavlink:send_chan(to.channel, P.TUNNEL, P.tunnel(to.system, to.component, data))
end

-- What is in force, to the companion that is obeyed and to one that is not.
local function report(now)
  local companion, listener = commands.companion, commands.listener
  if listener and now - listener.heard_ms >= T.OWNER_LOST_MS then
    listener = nil
  end
  if not (companion or listener) or (now - last_applied_ms < T.APPLIED_INTERVAL_MS and not commands.answer_now) then
    return
  end
  last_applied_ms, commands.answer_now = now, false
  applied_sequence = (applied_sequence + 1) % 65536
  local tables_check, complete = mixer.tables_check()
  local mask, check = mixer.show()
  local fields = {
    sequence = applied_sequence, time_ms = now, boot_ms = boot_ms, owner = commands.owner,
    declaration_sequence = commands.sequence(P.DECLARATION), matrix_sequence = commands.sequence(P.MATRIX),
    override_sequence = commands.sequence(P.OVERRIDE), failed = commands.held, source = source(now),
    flags = flags(now, complete), motors = motors, tables = mixer.count(), stock_check = mixer.stock_check,
    tables_check = tables_check, table = mask, table_check = check, accepted = commands.accepted,
  }
  for name, value in pairs(commands.refused) do
    fields[name] = value
  end
  local data = P.pack(P.APPLIED, fields)
  if companion then
    say(companion, data)
  end
  local heard = companion and listener and companion.channel == listener.channel
    and companion.component == listener.component
  if listener and not heard then
    say(listener, data)
  end
end

local function run()
  local now = millis():toint()
  if now - last_run_ms > T.APPLET_LATE_MS then
    mixer.forget() -- the watchdog may have put its own factors in force meanwhile
  end
  last_run_ms = now
  while commands.receive(now) do
  end
  if not arming:is_armed() then
    commands.drop()
    if commands.held ~= 0 then
      commands.set_held(0)
    end
  end
  local matrix = commands.matrix
  if matrix and (now >= matrix.expires_ms or not commands.linked(now)) then
    commands.matrix = nil
  end
  if now < commands.override_until_ms and commands.stopped_by_pilot() then
    for motor = 1, motors do
      commands.stop(motor)
    end
    commands.override_until_ms = 0
  end
  apply()
  if commands.held ~= 0 then
    for motor = 1, motors do
      if commands.is_held(motor) then
        commands.stop(motor)
      end
    end
  end
  local count = watchdog:get()
  if count ~= watchdog_count then
    watchdog_count, watchdog_seen_ms = count, now
  end
  mixer.check_next()
  report(now)
  ticks = (ticks + 1) % 30000
  alive:set(ticks)
end

function update()
  local good, message = pcall(run)
  if not good then
    errors = errors + 1
    -- Something we did not foresee: nothing streamed may stay in force.
    commands.drop()
    mixer.forget()
    pcall(apply)
    if errors % 100 == 1 then
      gcs:send_text(TEXT_WARNING, "NFF: " .. tostring(message))
    end
  end
  return update, 1
end

local function start()
  for motor = 1, motors do
    local from = motor <= 8 and 32 or 73 -- k_motor1 is function 33, k_motor9 82
    commands.channels[motor] = SRV_Channels:find_channel(from + motor)
  end
  mixer.start()
  mavlink:init(25, 25)
  mavlink:register_rx_msgid(P.TUNNEL)
  local mode = mixer.dynamic and "matrix and outputs" or "outputs only (FRAME_CLASS is not 17)"
  gcs:send_text(TEXT_INFO, string.format("NFF applet %d: %s, %s", P.VERSION, airframe.name, mode))
  return update, 1
end

return start()
