MODULE HrcGuide
    ! A PC that runs "hrcreplay live --send" guides ROB_1 over EGM. Start hrcreplay first, then this program.
    ! "hrc" is an External Motion Interface Data, "HrcPc" a Transmission Protocol of type UDPUC: see live.md.

    PERS tooldata gripper := [TRUE, [[0, 0, 100], [1, 0, 0, 0]], [0.5, [0, 0, 50], [1, 0, 0, 0], 0, 0, 0]];
    CONST jointtarget home := [[0, 0, 0, 0, 30, 0], [9E9, 9E9, 9E9, 9E9, 9E9, 9E9]];
    CONST egm_minmax near := [-0.1, 0.1];                  ! window of convergence [deg]
    VAR egmident guide;

    PROC main()
        MoveAbsJ home, v50, fine, gripper;

        EGMReset guide;
        EGMGetId guide;
        EGMSetupUC ROB_1, guide, "hrc", "HrcPc" \Joint \CommTimeout:=0.2;
        EGMActJoint guide \Tool:=gripper
            \J1:=near \J2:=near \J3:=near \J4:=near \J5:=near \J6:=near
            \LpFilter:=20 \SampleRate:=4 \MaxSpeedDeviation:=20;
        EGMRunJoint guide, EGM_STOP_HOLD \J1 \J2 \J3 \J4 \J5 \J6
            \CondTime:=3600 \RampInTime:=0.05 \RampOutTime:=0.5 \PosCorrGain:=1;

        TPWrite "Guidance has ended: nobody moved for CondTime";
        EGMReset guide;
    ERROR
        IF ERRNO = ERR_UDPUC_COMM THEN
            TPWrite "Guidance has ended: the PC did not answer within CommTimeout";
            EGMReset guide;
            EXIT;                                          ! a person decides when to go on
        ENDIF
        RAISE;
    ENDPROC
ENDMODULE
