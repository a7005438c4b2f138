-- What goes through TUNNEL between the companion and the applet. The layout is described in tunnel.py, which has the
-- same functions; every message is encoded to the same bytes by both.
-- Integers stay below 2^31: integers of this Lua have 32 bits.

local P = {}

P.VERSION = 2
P.TUNNEL = 385
P.TO_AUTOPILOT = 54100
P.TO_COMPANION = 54101
P.FACTOR_SCALE = 4096
P.END = 0xA5
P.CHECKS = 65521 -- checks are below this prime
P.YAW_RELEASED, P.LEAVING = 1, 1 -- flags of MATRIX, and of RELEASE

P.HEARTBEAT, P.TABLE, P.DECLARATION, P.MATRIX, P.RELEASE, P.OVERRIDE = 1, 2, 3, 4, 5, 6
P.APPLIED, P.STORED = 129, 130

P.REFUSALS = {
  "range", "format", "stale", "replay", "dimension", "disarmed", "unsupported", "armed", "occupied",
}

local TUNNEL_PAYLOAD = 128
local HEAD = 12 -- bytes of mavlink_message_t before its payload

-- fixed part after version and kind; field names in order; what repeats after it, and how often
local LAYOUT = {
  [P.HEARTBEAT] = { "<HH", { "sequence", "instance" } },
  [P.TABLE] = { "<HHHB", { "sequence", "instance", "failed", "motors" }, "factors", "i2", 4 },
  [P.DECLARATION] = { "<HHI4H", { "sequence", "instance", "sample_ms", "failed" } },
  [P.MATRIX] = {
    "<HHI4HHBB", { "sequence", "instance", "sample_ms", "timeout_ms", "failed", "flags", "motors" }, "factors", "i2", 4,
  },
  [P.RELEASE] = { "<HHI4B", { "sequence", "instance", "sample_ms", "flags" } },
  [P.OVERRIDE] = { "<HHI4HB", { "sequence", "instance", "sample_ms", "timeout_ms", "motors" }, "pwm", "I2", 1 },
  [P.APPLIED] = {
    "<HI4I4HHHHHBBBBHHHHHHHHHHHHHH",
    {
      "sequence", "time_ms", "boot_ms", "owner", "declaration_sequence", "matrix_sequence", "override_sequence",
      "failed", "source", "flags", "motors", "tables", "stock_check", "tables_check", "table", "table_check",
      "accepted",
      "range", "format", "stale", "replay", "dimension", "disarmed", "unsupported", "armed", "occupied",
    },
  },
  [P.STORED] = { "<HHH", { "sequence", "failed", "check" } },
}

-- Sum over bytes: firmware hands frames with a wrong CRC to scripts too, so every message has its own.
function P.check(data)
  local sum = 1
  for i = 1, #data do
    sum = (sum * 31 + data:byte(i)) % P.CHECKS
  end
  return sum
end

-- The same of one table and the mask (of at most 12 motors) that it is for: multiplied, so that two tables that change
-- places are seen. The check of all tables is the sum of these, modulo P.CHECKS.
function P.table_check(failed, factors)
  return P.check(factors) * (failed + 1) % P.CHECKS
end

-- Fields of one message as a string.
function P.pack(kind, fields)
  local layout = LAYOUT[kind]
  local values = {}
  for i, name in ipairs(layout[2]) do
    values[i] = fields[name]
  end
  local out = string.pack("<BB", P.VERSION, kind) .. string.pack(layout[1], table.unpack(values))
  if layout[3] then
    out = out .. fields[layout[3]]
  end
  return out .. string.pack("<HB", P.check(out), P.END)
end

-- Fields of one message, nil when it is none of ours. What repeats stays a string: it is unpacked when it is used.
function P.unpack(data)
  if #data < 5 or data:byte(1) ~= P.VERSION or data:byte(#data) ~= P.END then
    return nil
  end
  local body = data:sub(1, #data - 3)
  local layout = LAYOUT[data:byte(2)]
  if not layout or #body < 2 + string.packsize(layout[1]) or string.unpack("<H", data, #data - 2) ~= P.check(body) then
    return nil
  end
  local fields = { kind = data:byte(2) }
  local values = { string.unpack(layout[1], data, 3) }
  for i, name in ipairs(layout[2]) do
    fields[name] = values[i]
  end
  local rest = body:sub(values[#values])
  if layout[3] then
    if #rest ~= fields.motors * layout[5] * string.packsize("<" .. layout[4]) then
      return nil
    end
    fields[layout[3]] = rest
  elseif #rest > 0 then
    return nil
  end
  return fields
end

-- Payload of a TUNNEL message.
function P.tunnel(system, component, data)
  return string.pack("<HBBB", P.TO_COMPANION, system, component, #data) .. data .. ("\0"):rep(TUNNEL_PAYLOAD - #data)
end

-- Fields and sender (system, component) of a received mavlink_message_t; nil when it is none of ours.
-- The end mark is set by the sender: bytes that were cut off or left over do not go unseen.
function P.open(message, own_system)
  local payload_type, system, _, length = string.unpack("<HBBB", message, HEAD + 1)
  if payload_type ~= P.TO_AUTOPILOT or system ~= own_system or length > TUNNEL_PAYLOAD then
    return nil
  end
  local from_system, from_component = message:byte(8), message:byte(9)
  return P.unpack(message:sub(HEAD + 6, HEAD + 5 + length)), from_system, from_component
end

return P
